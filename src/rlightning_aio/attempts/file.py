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
from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_writable

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from rlightning_aio.attempts.records import Attempt

__all__ = ["ResultsFile"]


class ResultsFile:
    """Attempts as JSON lines, for this process alone; `play` and `evaluate` continue from it.

    A line holds an attempt after its last try, as of `Attempt.to_json`. An attempt that had not
    ended starts over. Cancelled attempts are not written: with ``Rules(first=…)`` a task is done
    when as many others are in the file.

    ::

        with ResultsFile("results.jsonl", {"policy": "act-1"}) as results:
            evaluate(group, policy, episodes, results=results)

    Args:
        path: the file, created if it is missing; a link is followed.
        subject: what plays, as JSON values: the first line of the file. A file with another subject
            is refused.

    Attributes:
        played: the attempts in the file.

    Raises:
        ConfigError: the file can't be read and written, another process has it open, it belongs
            to something else, or it is damaged.
    """

    def __init__(
        self, path: str | os.PathLike[str], subject: Mapping[str, Any] | None = None
    ) -> None:
        self._name = f"results file {os.fspath(path)}"
        self.played: list[Attempt] = []
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

    def add(self, attempt: Attempt) -> None:
        """Save an attempt after its last try, as `play` and `evaluate` do.

        Raises:
            ConfigError: it can't be written; the file is unchanged.
        """
        self._write(attempt.to_json())
        self.played.append(attempt)

    def close(self) -> None:
        """Close the file, so that another process may open it."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

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
        text, first = self._file.read(), _line_of(subject)
        if len(text) < len(first) and first.startswith(text):  # Empty, or cut in that line.
            self._file.truncate(0)
            self._write(subject)
            return
        whole = text[: text.rfind(b"\n") + 1]
        try:
            before, *rows = [{**json.loads(line)} for line in whole.splitlines()]
            self.played += map(attempt_of, rows)
        except (ValueError, TypeError, KeyError):
            raise ConfigError(f"{self._name}: is not a file of results") from None
        if before != subject:
            raise ConfigError(
                f"{self._name}: belongs to {before}, not to {subject}; name another file, or use "
                "the same settings as before"
            )
        self._file.truncate(len(whole))

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


def _line_of(value: dict[str, Any]) -> bytes:
    return f"{json.dumps(value, allow_nan=False)}\n".encode()
