"""Processes of this machine: what a worker's envs have started (browsers, simulators, shells) is
found and killed with it; the memory and the processor time that one uses; how one has ended.

A process whose parent ends becomes a child of its nearest ancestor that adopts. Each worker adopts,
so that all that its envs have started stays below it, also what begins a session of its own. The
fork server adopts, too: of what it has as children, all but its workers comes from workers that
ended.
Rule: only the standard library, as the fork server imports this before it knows what is installed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

_OUTLIVES: Final = b"\0RLIGHTNING_AIO_OUTLIVES=1\0"
"""In the environment of a process that is not killed: the watchdog of an arm has to stop the arm
then, and ends by itself.
"""

_PR_SET_CHILD_SUBREAPER: Final = 36
_PAGE_MB: Final = os.sysconf("SC_PAGE_SIZE") / 1e6
_MOST_ROUNDS: Final = 100
"""Each kills all that was found, so a second one only meets what was started meanwhile."""


def adopt_orphans() -> None:
    """Become the parent of descendants whose parents end (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def children() -> dict[int, list[int]]:
    """Return the children of each process of this system that has any and has not ended."""
    found: dict[int, list[int]] = {}
    try:
        pids = [int(one.name) for one in Path("/proc").iterdir() if one.name.isdecimal()]
    except OSError:  # There are no descriptors.
        return found
    for pid in pids:
        state, parent = _state_and_parent(pid)
        if state not in (b"Z", b"X"):
            found.setdefault(parent, []).append(pid)
    return found


def is_suspended(pid: int) -> bool:
    """Return True if a process was stopped, by a signal or a debugger."""
    return _state_and_parent(pid)[0] in (b"T", b"t")


def _state_and_parent(pid: int) -> tuple[bytes, int]:
    """Return the kernel's letter for the state of a process, ``X`` once it has ended, and the pid
    of its parent.
    """
    try:
        # The name in parentheses may contain anything.
        text = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b") ")[2]
    except OSError:  # It has ended, or this isn't Linux.
        return b"X", 0
    state, parent, *_ = text.split()
    return state, int(parent)


def kill_below(process: int, but: Collection[int] = ()) -> None:
    """Kill all descendants of a process, except children in `but` and what is below those.

    Those that outlive a worker (`_OUTLIVES`) are left out, too, with what is below them. Whatever
    is started meanwhile is found in another round, for its parent dies before it or is found with
    it.
    """
    killed: set[int] = set()
    for _ in range(_MOST_ROUNDS):
        of = children()
        below = _killable(pid for pid in of.get(process, []) if pid not in but)
        for pid in below:
            below += _killable(of.get(pid, []))
        if killed.issuperset(below):
            return
        for pid in below:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        killed.update(below)


def _killable(pids: Iterable[int]) -> list[int]:
    return [pid for pid in pids if _OUTLIVES not in _variables(pid)]


def _variables(pid: int) -> bytes:
    try:
        return b"\0" + Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:  # It has ended meanwhile, or it is another user's.
        return b""


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process and its descendants in MB; 0 if it has ended."""
    process = Path(f"/proc/{pid}")
    try:
        pages = int((process / "statm").read_text().split()[1])
        threads = [*(process / "task").iterdir()]
    except (OSError, ValueError):  # It has ended meanwhile, or this isn't Linux.
        return 0.0
    children: list[int] = []
    for thread in threads:
        with contextlib.suppress(OSError):  # A thread may have ended, too.
            children += map(int, (thread / "children").read_text().split())
    return pages * _PAGE_MB + sum(map(resident_mb, children))


def processor_ns(pid: int) -> int | None:
    """Return for how long the living threads of a process have run or waited for a core, in ns.

    None if the process has ended, or the kernel keeps no such accounts.
    """
    ran = 0
    try:
        for accounts in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            on_core, in_queue, _ = accounts.read_text().split()
            ran += int(on_core) + int(in_queue)
    except (OSError, ValueError):
        return None  # A thread has ended meanwhile, or the accounts have another form.
    return ran or None


def ending(exit_code: int) -> str:
    """Say in a clause how a process ended; `exit_code` is negative for a signal."""
    if exit_code >= 0:
        return f"exited with code {exit_code}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    hint = ""
    if exit_code == -signal.SIGKILL:
        hint = " (if you didn't, the kernel may have run out of memory: see dmesg)"
    return f"was killed by {name}{hint}"
