"""`ResultsFile`: attempts as JSON lines; an interrupted run or evaluation resumes from them.

Rule: one process at a time writes a file, and each line is complete before the next one. So however
a run ends, the file holds each attempt that has ended, once. An incomplete last line is ignored.
The first line says what plays.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rlightning_aio.attempts.records import attempt_of
from rlightning_aio.attempts.spec import spec_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_writable
from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from rlightning_aio.attempts.records import Attempt
    from rlightning_aio.attempts.spec import EpisodeKey, EpisodeSpec

__all__ = ["AttemptLog", "ResultsFile", "log_of"]


class AttemptLog:
    """What a `ResultsFile` does for `AttemptQueue`.

    Args:
        path: see `ResultsFile`.
        subject: see `ResultsFile`.

    Attributes:
        played: see `ResultsFile`.
    """

    def __init__(
        self, path: str | os.PathLike[str], subject: Mapping[str, Any] | None = None
    ) -> None:
        self._name = f"results file {os.fspath(path)}"
        self.played: list[Attempt] = []
        self._failures: dict[tuple[EpisodeKey, int, int], list[Outcome]] = {}
        try:
            # Converted as reading does it: lists for tuples, texts for the keys of dicts.
            about: dict[str, Any] = json.loads(json.dumps({**(subject or {})}, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{self._name}: its subject can't be written as JSON: {error}"
            ) from error
        with self._writing():
            check_writable(path)
            # Unbuffered, so that `close` does not write a line again that could not be written.
            self._file = Path(path).open("a+b", buffering=0)  # noqa: SIM115  # See `close`.
        try:
            self._lock()
            self._read(about)
        except BaseException:
            self._file.close()
            raise

    # -- attempts ---------------------------------------------------------------------

    def add(self, attempt: Attempt) -> None:
        """Save an attempt after its last try.

        Raises:
            ConfigError: it can't be written; the file is unchanged.
        """
        self._write(attempt.to_json())
        self._note(attempt)

    def add_failure(self, spec: EpisodeSpec, index: int, sub_env: int, outcome: Outcome) -> None:
        """Save how a try of an attempt has failed that may be tried again.

        Raises:
            ConfigError: it can't be written; the file is unchanged.
        """
        place = {**spec.to_json(), "index": index, "sub_env": sub_env}
        self._write({**place, "failed_try": outcome.to_json()})
        self._failures.setdefault((spec.key, index, sub_env), []).append(outcome)

    def failures(self, spec: EpisodeSpec, index: int, sub_env: int = 0) -> list[Outcome]:
        """Outcomes of the tries of an attempt that has not ended yet."""
        return [*self._failures.get((spec.key, index, sub_env), ())]

    def by_place(self) -> dict[tuple[EpisodeKey, int, int], list[Attempt]]:
        """The attempts in the file by the `key` of their task, their index and sub-environment.

        There is more than one where the same task was there several times.
        """
        found: dict[tuple[EpisodeKey, int, int], list[Attempt]] = {}
        for attempt in self.played:
            found.setdefault(_place(attempt), []).append(attempt)
        return found

    def _note(self, attempt: Attempt) -> None:
        self.played.append(attempt)
        left = self._failures.get(_place(attempt), [])
        for outcome in attempt.failures:  # The task may be there twice; the rest is the other's.
            if outcome in left:
                left.remove(outcome)

    # -- lines ------------------------------------------------------------------------

    @contextlib.contextmanager
    def _writing(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            raise ConfigError(f"{self._name}: can't be written: {error.strerror}") from error

    def _lock(self) -> None:
        """Lock the file until it is closed, or until this process ends in any way."""
        with self._writing():
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(
                    f"{self._name}: another program is writing this file; wait for it to "
                    "end, or name another file"
                ) from None

    def _read(self, subject: dict[str, Any]) -> None:
        self._file.seek(0)
        foreign = ConfigError(f"{self._name}: is not a file of results")
        try:
            text, first = self._file.read(), _line_of(subject)
            if len(text) < len(first) and first.startswith(text):  # Empty, or cut in that line.
                self._file.truncate(0)
                self._write(subject)
                return
            whole = text[: text.rfind(b"\n") + 1]
            values: list[Any] = [json.loads(line) for line in whole.splitlines()]
            before: dict[str, Any] = {**values[0]} if values else {}
            for value in values[1:]:
                self._read_line({**value})
        except (ValueError, TypeError, KeyError):
            raise foreign from None
        if not values or before.keys() != subject.keys():
            raise foreign
        if before != subject:
            differences = "; ".join(
                f"its {key} is {before[key]}, not {subject[key]}"
                for key in subject
                if before[key] != subject[key]
            )
            raise ConfigError(
                f"{self._name}: belongs to something else ({differences}); name another file, or "
                "use the same settings as before"
            )
        self._file.truncate(len(whole))

    def _read_line(self, row: dict[str, Any]) -> None:
        if "failed_try" not in row:
            self._note(attempt_of(row))
            return
        outcome, spec = Outcome.from_json(row.pop("failed_try")), spec_of(row)
        place = spec.key, row["index"], row["sub_env"]
        self._failures.setdefault(place, []).append(outcome)

    def _write(self, value: dict[str, Any]) -> None:
        """Append a line; it is complete, or the file is unchanged."""
        line = _line_of(value)
        with self._writing():
            end = self._file.seek(0, os.SEEK_END)
            try:
                while line:
                    line = line[self._file.write(line) :]
            except OSError:
                self._file.truncate(end)
                raise

    def close(self) -> None:
        """Close the file, so that another process may open it."""
        self._file.close()


def _place(attempt: Attempt) -> tuple[EpisodeKey, int, int]:
    return attempt.spec.key, attempt.index, attempt.sub_env


def _line_of(value: dict[str, Any]) -> bytes:
    return f"{json.dumps(value, allow_nan=False)}\n".encode()


class ResultsFile:
    """Attempts as JSON lines, for this process alone; `play` and `evaluate` continue from it.

    A line holds an attempt after its last try, as of `Attempt.to_json`, or, with ``failed_try``,
    the outcome of a try after which there may be another. Cancelled attempts are not written: with
    ``Rules(first=…)`` a task is done when as many others are in the file.

    ::

        with ResultsFile("results.jsonl", {"policy": "act-1"}) as results:
            evaluate(group, policy, episodes, results=results)

    Args:
        path: the file, created if it is missing; a link is followed.
        subject: what plays, as JSON values: the first line of the file. A file with another subject
            is refused.

    Raises:
        ConfigError: the file can't be read and written, another process has it open, it belongs
            to something else, or it is damaged.
    """

    def __init__(
        self, path: str | os.PathLike[str], subject: Mapping[str, Any] | None = None
    ) -> None:
        self._log = AttemptLog(path, subject)

    @property
    def played(self) -> list[Attempt]:
        """The attempts in the file."""
        return self._log.played

    def close(self) -> None:
        """Close the file, so that another process may open it."""
        self._log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def log_of(results: ResultsFile) -> AttemptLog:
    """Return what `AttemptQueue` reads and writes."""
    return results._log  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # Same module.
