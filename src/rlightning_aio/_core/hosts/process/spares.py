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

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.process.fork_messages import MessageSocket

__all__ = ["Key", "Spare", "end_all", "keep", "kept", "surroundings", "take"]

Key: TypeAlias = tuple[object, ...]

_MOST: Final = 3
_END_SECONDS: Final = 1.0
_INHERITED: Final = (
    *("Umask", "Uid", "Gid", "Groups"),
    *("SigIgn", "NoNewPrivs", "Seccomp", "Cpus_allowed", "Mems_allowed"),
)
"""Lines of /proc/self/status about what a new process inherits."""


class Spare(NamedTuple):
    """A fork server that is ready: the trainer's end of its socket, and its process."""

    messages: MessageSocket
    process: subprocess.Popen[bytes]


_spares: dict[Key, Spare] = {}


def surroundings() -> Key:
    """Return what a process would inherit that this thread starts now."""
    thread = Path("/proc/thread-self")
    status = (thread / "status").read_text().splitlines()
    try:
        folder = Path.cwd()
    except FileNotFoundError:  # It was deleted.
        folder = None
    try:
        stderr = os.fstat(2)[:3]
    except OSError:  # It is closed.
        stderr = ()
    return (
        tuple(sorted(os.environ.items())),
        tuple(sys.path),
        folder,
        stderr,
        tuple(line for line in status if line.startswith(_INHERITED)),
        (thread / "limits").read_text(),
        (thread / "cgroup").read_text(),
        os.getpriority(os.PRIO_PROCESS, 0),
    )


def keep(key: Key, spare: Spare) -> None:
    """Keep a fork server that was started in the surroundings `key`; it belongs to this module."""
    if key in _spares:
        _end(spare)
        return
    _spares[key] = spare
    while len(_spares) > _MOST:
        _end(_spares.pop(next(iter(_spares))))


def take(key: Key) -> Spare | None:
    """Hand out a fork server that still runs; None if there is none."""
    spare = _spares.pop(key, None)
    if spare is None or spare.process.poll() is None:
        return spare
    _end(spare)
    return None


def kept() -> list[Spare]:
    """Return all spares."""
    return list(_spares.values())


def end_all() -> None:
    """End all spares."""
    while _spares:
        _end(_spares.popitem()[1])


def _end(spare: Spare) -> None:
    spare.messages.close()
    try:
        spare.process.wait(_END_SECONDS)
    except subprocess.TimeoutExpired:
        spare.process.kill()
        spare.process.wait()


def _forget() -> None:
    """Drop the spares of the parent in a process that was forked."""
    while _spares:
        messages, process = _spares.popitem()[1]
        messages.close()
        process.returncode = 0  # The child of another process, so no warning is due.


atexit.register(end_all)
os.register_at_fork(after_in_child=_forget)
