"""Files of finished episodes, from which an interrupted evaluation resumes.

Rule: one process at a time writes a file, and each line of JSON is complete before the next one. So
however the evaluation ends, the file holds finished episodes only, each once. An incomplete last
line is ignored. The first line is the subject of the evaluation.
"""

from __future__ import annotations

import abc
import contextlib
import fcntl
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_writable

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

__all__ = ["EpisodeFile"]

E = TypeVar("E")


class EpisodeFile(abc.ABC, Generic[E]):
    """A file of episodes of one kind.

    Args:
        path: the file, created if it is missing; a link is followed.
        subject: what is played, as JSON values: the first line of the file. A file with another
            subject is refused.
        label: what messages call the file.

    Attributes:
        played: the episodes in the file.

    Raises:
        ConfigError: the file can't be read and written, another process has it open, it belongs
            to something else, or it is damaged.
    """

    def __init__(
        self, path: str | os.PathLike[str], subject: Mapping[str, Any], *, label: str
    ) -> None:
        self._name, self.played = f"{label} {os.fspath(path)}", list[E]()
        try:
            # As it is read again: lists for tuples, texts for the keys of dicts.
            about: dict[str, Any] = json.loads(json.dumps({**subject}, allow_nan=False))
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

    @abc.abstractmethod
    def _encode(self, episode: E) -> dict[str, Any]:
        """Return an episode as JSON values, without NaN and infinity."""

    @abc.abstractmethod
    def _decode(self, value: dict[str, Any]) -> E | None:
        """Return the episode of a line, or None if the line only belongs to one.

        Raises TypeError, ValueError or KeyError if it is neither.
        """

    @abc.abstractmethod
    def _check(self, played: list[E]) -> None:
        """Raise ValueError if the episodes of a file can't be those of one evaluation."""

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
                    f"{self._name}: another eval is writing this file; wait for it to "
                    "end, or name another file"
                ) from None

    def _read(self, subject: dict[str, Any]) -> None:
        self._file.seek(0)
        foreign = ConfigError(f"{self._name}: is not a file written by eval")
        try:
            text, first = self._file.read(), _line_of(subject)
            if len(text) < len(first) and first.startswith(text):  # Empty, or cut in that line.
                self._file.truncate(0)
                self.write_line(subject)
                return
            whole = text[: text.rfind(b"\n") + 1]
            values: list[Any] = [json.loads(line) for line in whole.splitlines()]
            before: dict[str, Any] = {**values[0]} if values else {}
            decoded = [self._decode({**value}) for value in values[1:]]
            self.played = [episode for episode in decoded if episode is not None]
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
                f"{self._name}: belongs to another evaluation ({differences}); name "
                "another file, or use the same settings as before"
            )
        try:
            self._check(self.played)
        except ValueError as error:
            raise ConfigError(
                f"{self._name}: {error}, so its figures would be wrong; remove that line "
                "and those after it, or name another file"
            ) from None
        self._file.truncate(len(whole))

    def add(self, episode: E) -> None:
        """Save a finished episode.

        Raises:
            ConfigError: it can't be written; the file is unchanged.
        """
        self.write_line(self._encode(episode))
        self.played.append(episode)

    def write_line(self, value: dict[str, Any]) -> None:
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _line_of(value: dict[str, Any]) -> bytes:
    return f"{json.dumps(value, allow_nan=False)}\n".encode()
