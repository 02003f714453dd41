"""This machine: what its processes use, as the kernel counts it, and what figures depend on.

Rule: `bench` and the scripts of benchmarks/ both measure with this module.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

__all__ = ["cpu_seconds", "machine_facts", "memory_bytes"]

_ALWAYS_USED: Final = ("rlightning_aio", "gymnasium", "mujoco", "numpy", "uvloop")

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


def machine_facts(modules: Iterable[str]) -> dict[str, Any]:
    """Return what figures depend on besides the code.

    Args:
        modules: that take part, besides those that always do; each version is named.
    """
    versions: dict[str, str] = {}
    distributions = _distributions()
    for name in (*_ALWAYS_USED, *sorted(set(modules) - set(_ALWAYS_USED))):
        try:
            versions[name] = importlib.metadata.version(distributions.get(name, [name])[0])
        except importlib.metadata.PackageNotFoundError:
            continue  # Not installed, or a module of a folder.
    return {
        "cores": num_cores(),
        "cpu": _cpu_model(),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": versions,
        "date": time.strftime("%Y-%m-%d"),
        # Other work on the machine at that moment.
        "load_average": round(os.getloadavg()[0], 2),
    }


@cache
def _distributions() -> Mapping[str, list[str]]:
    """Return the distributions of each module. It reads the list of every installed file."""
    return importlib.metadata.packages_distributions()


def _cpu_model() -> str:
    for line in _read("/proc/cpuinfo").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def _read(path: str) -> str:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""
