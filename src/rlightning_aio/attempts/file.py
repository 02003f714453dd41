"""`ResultsFile`: attempts as JSON lines; an interrupted run or evaluation resumes from them.

Rule: one process at a time writes a file, and each line is complete before the next one. A group of
attempts is handed out when its lines are there. So however a run ends, none is lost. An incomplete
last line is ignored.
The first line says what plays.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
from collections import Counter
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, TypeAlias

from rlightning_aio.attempts.records import attempt_of
from rlightning_aio.attempts.rules import is_final
from rlightning_aio.attempts.spec import spec_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_writable

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping

    from rlightning_aio.attempts.records import Attempt
    from rlightning_aio.attempts.spec import EpisodeKey, EpisodeSpec

_HANDED_OUT: Final = "handed_out"


def new_writer() -> Executor:
    """Make what writes the lines, one after another."""
    return ThreadPoolExecutor(1, "results file")


_Place: TypeAlias = "tuple[EpisodeKey, int, int]"
"""What identifies an attempt: its episode's key, its index and its sub-environment."""


class _Line(NamedTuple):
    start: int
    length: int
    is_final: bool


class ResultsFile:
    """Attempts as JSON lines, for this process alone; `play` and `evaluate` continue from it.

    A line holds an attempt after its last try, as of `Attempt.to_json`, or says which group of
    attempts `play` has handed out. An attempt that had not ended starts over, and so does one that
    has failed by no fault of the policy; the last line of an attempt counts. Cancelled attempts are
    not written: with ``Rules(first=…)`` a task is done when as many others are in the file. Lines
    are written by a thread of its own, and read again when they are asked for.

    ::

        with ResultsFile("results.jsonl", {"policy": "act-1"}) as results:
            evaluate(group, policy, episodes, results=results)

    Its length is the number of attempts in it, and its elements are these.

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
        self._name = f"results file {os.fspath(path)}"
        self._lines: dict[_Place, _Line] = {}
        self._handed_out: set[EpisodeKey] = set()
        self._writer = new_writer()
        self._last: Future[None] | None = None
        self._error: ConfigError | None = None
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
        """Have an attempt written after its last try, as `play` and `evaluate` do.

        Raises:
            ConfigError: what was given before can't be written.
        """
        self._submit(self._add, attempt)

    def hand_out(self, spec: EpisodeSpec) -> None:
        """Have it written that the attempts at a task are handed out; it raises as `add` does."""
        self._handed_out.add(spec.key)
        self._submit(self._write, {_HANDED_OUT: spec.to_json()})

    def is_handed_out(self, spec: EpisodeSpec) -> bool:
        """Return True if the attempts at a task were handed out."""
        return spec.key in self._handed_out

    def left(self) -> Counter[EpisodeKey]:
        """Count the attempts in groups that were not handed out, but those to be played again."""
        self.flush()
        final = (key for (key, _, _), line in self._lines.items() if line.is_final)
        return Counter(key for key in final if key not in self._handed_out)

    def find(self, spec: EpisodeSpec, index: int, sub_env: int = 0) -> Attempt | None:
        """Read an attempt that is not played again; None if there is none."""
        line = self._lines.get((spec.key, index, sub_env))
        return self._attempt_at(line) if line is not None and line.is_final else None

    def __len__(self) -> int:
        self.flush()
        return len(self._lines)

    def __iter__(self) -> Iterator[Attempt]:
        self.flush()
        return map(self._attempt_at, [*self._lines.values()])

    def flush(self) -> None:
        """Wait until all is written.

        Raises:
            ConfigError: something can't be written; the file has no part of it.
        """
        if self._last is not None:
            self._last.result()
        self._check()

    async def written(self) -> None:
        """Wait as `flush` does, beside an event loop."""
        if self._last is not None and not self._last.done():
            # Cancelled, this goes on without it: the line is still to be written.
            await asyncio.wait([asyncio.wrap_future(self._last)])
        self._check()

    def close(self) -> None:
        """Close the file, so that another process may open it; raises as `flush` does."""
        self._writer.shutdown()
        self._file.close()
        self._check()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # -- the thread that writes -------------------------------------------------------

    def _submit(self, write: Callable[[Any], object], what: Any) -> None:
        self._check()
        self._last = self._writer.submit(self._noting, write, what)

    def _noting(self, write: Callable[[Any], object], what: Any) -> None:
        """Write, unless something before could not be written."""
        if self._error is None:
            try:
                write(what)
            except ConfigError as error:
                self._error = error
            except Exception as error:  # noqa: BLE001  # The next call raises it.
                self._error = ConfigError(f"{self._name}: a line can't be written: {error!r}")
                self._error.__cause__ = error

    def _add(self, attempt: Attempt) -> None:
        self._keep(attempt, *self._write(attempt.to_json()))

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    # -- lines ------------------------------------------------------------------------

    @contextlib.contextmanager
    def _writing(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            raise ConfigError(f"{self._name}: can't be written: {error.strerror}") from error

    def _attempt_at(self, line: _Line) -> Attempt:
        return attempt_of(json.loads(os.pread(self._file.fileno(), line.length, line.start)))

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
        first, start = _line_of(subject), 0
        with open(self._file.fileno(), "rb", closefd=False) as lines:
            line = lines.readline()
            if len(line) < len(first) and first.startswith(line):  # Empty, or cut in that line.
                self._file.truncate(0)
                self._write(subject)
                return
            try:
                before = {**json.loads(line)}
                start = len(line)
                while (line := lines.readline()).endswith(b"\n"):
                    self._note(json.loads(line), start, len(line))
                    start += len(line)
            except (ValueError, TypeError, KeyError):
                raise ConfigError(f"{self._name}: is not a file of results") from None
        if before != subject:
            raise ConfigError(
                f"{self._name}: belongs to {before}, not to {subject}; name another file, or use "
                "the same settings as before"
            )
        self._file.truncate(start)

    def _note(self, row: dict[str, Any], start: int, length: int) -> None:
        """Note a line, not what it has: that is megabytes."""
        if _HANDED_OUT in row:
            self._handed_out.add(spec_of(row[_HANDED_OUT]).key)
            return
        self._keep(attempt_of(row), start, length)

    def _keep(self, attempt: Attempt, start: int, length: int) -> None:
        place = attempt.spec.key, attempt.index, attempt.sub_env
        self._lines[place] = _Line(start, length, is_final(attempt.outcome))

    def _write(self, value: dict[str, Any]) -> tuple[int, int]:
        """Append a line; return its place. It is complete, or the file is unchanged."""
        line = _line_of(value)
        length = len(line)
        with self._writing():
            end = self._file.seek(0, os.SEEK_END)
            try:
                while line:
                    line = line[self._file.write(line) :]
            except OSError:
                self._file.truncate(end)
                raise
        return end, length


def _line_of(value: dict[str, Any]) -> bytes:
    return f"{json.dumps(value, allow_nan=False)}\n".encode()
