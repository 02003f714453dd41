"""Resource use of this machine's processes, as the kernel counts it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["cpu_model", "cpu_seconds", "memory_bytes"]

_TICKS: Final = os.sysconf("SC_CLK_TCK")
_USER_TICKS: Final = 11
"""Position of user time behind a process's name; kernel time follows it."""


def cpu_seconds(pids: Sequence[int]) -> float:
    """Return the CPU time of the processes so far; one that has ended counts as 0."""
    return sum(map(_cpu_seconds, pids))


def _cpu_seconds(pid: int) -> float:
    if pid == os.getpid():
        used = os.times()
        return used.user + used.system
    text = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()
    return sum(map(int, text[_USER_TICKS : _USER_TICKS + 2])) / _TICKS


def memory_bytes(pids: Sequence[int]) -> int:
    """Return the memory of the processes, with shared memory divided among its users."""
    return sum(map(_memory_bytes, pids))


def _memory_bytes(pid: int) -> int:
    for line in _read(f"/proc/{pid}/smaps_rollup").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    return 0


def cpu_model() -> str:
    """Return the name of this machine's processor, or an empty string."""
    for line in _read("/proc/cpuinfo").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return ""


def _read(path: str) -> str:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""
