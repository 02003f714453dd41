"""Fork servers that no group uses now: the next group in the same surroundings continues with one.

A fork server needs half a second of a processor to import what workers need, which a second group
of the program then has for nothing. Spares end with the program, as the trainer's exit ends any
fork server.
Invariant: a spare has no workers, and has told all it had to tell.
Left out on purpose: what a fork server is told (see `host`).
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.processes import kill_below

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.process.fork_messages import MessageSocket

Key: TypeAlias = tuple[object, ...]

_MOST: Final = 3


class RunningForkServer(NamedTuple):
    """A fork server that was started: the trainer's end of its socket, and its process."""

    messages: MessageSocket
    process: subprocess.Popen[bytes]

    def end(self, seconds: float) -> int:
        """End it, which ends its workers within `seconds`, and return its exit code."""
        self.messages.close()
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return self.process.wait()

    def kill(self) -> None:
        """Kill it with its workers, and with all that those have started."""
        if self.process.poll() is None:
            kill_below(self.process.pid)
        self.process.kill()

    def disown(self) -> None:
        """Drop it in a process that was forked; the parent continues to use it."""
        self.messages.close()
        self.process.returncode = 0  # The child of another process, so no warning is due.


_spares: dict[Key, RunningForkServer] = {}


def inherited() -> Key:
    """Return what programs change of what a process inherits that is started now."""
    try:
        folder = Path.cwd()
    except FileNotFoundError:  # It was deleted.
        folder = None
    return (
        tuple(sorted(os.environ.items())),
        tuple(sys.path),
        folder,
        _file(1),
        _file(2),
    )


def _file(descriptor: int) -> tuple[int, ...]:
    """Return the identity of an open file; nothing if the descriptor is closed."""
    try:
        return os.fstat(descriptor)[:3]
    except OSError:
        return ()


def keep(key: Key, spare: RunningForkServer) -> None:
    """Keep a fork server that was started in the surroundings `key`; it belongs to this module."""
    if key in _spares:
        spare.end(times.CLOSE)
        return
    _spares[key] = spare
    while len(_spares) > _MOST:
        _spares.pop(next(iter(_spares))).end(times.CLOSE)


def take(key: Key) -> RunningForkServer | None:
    """Hand out a fork server that still runs; None if there is none."""
    spare = _spares.pop(key, None)
    if spare is None or spare.process.poll() is None:
        return spare
    spare.end(times.CLOSE)
    return None


def kept() -> list[RunningForkServer]:
    """Return all spares."""
    return list(_spares.values())


def end_all() -> None:
    """End all spares."""
    while _spares:
        _spares.popitem()[1].end(times.CLOSE)


def _disown_all() -> None:
    while _spares:
        _spares.popitem()[1].disown()


atexit.register(end_all)
os.register_at_fork(after_in_child=_disown_all)
