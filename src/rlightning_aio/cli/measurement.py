"""Measuring: turns, figures, what processes use, and what figures depend on.

Rule: `bench` and the scripts of benchmarks/ both measure with this module. Contenders take turns
(A B C A B C …), a figure is a median over rounds, and a ratio one over pairs of the same round. So
a machine that slows down for a while slows all of them down.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

C = TypeVar("C")
_ALWAYS_USED: Final = ("rlightning_aio", "gymnasium", "mujoco", "numpy", "uvloop")


def in_turns(contenders: Sequence[C], rounds: int) -> Iterator[tuple[int, C]]:
    """Yield the number of the round and a contender: those that are left when a round begins."""
    for number in range(rounds):
        for contender in list(contenders):
            yield number, contender


@dataclass(frozen=True)
class Figures:
    """The measured values, one for each round, in order."""

    values: Sequence[float]

    @property
    def median(self) -> float:
        """0 without any."""
        return median(self.values) if self.values else 0.0

    @property
    def spread(self) -> float:
        """Half the range of the values, as a share of the median."""
        return (max(self.values) - min(self.values)) / 2 / self.median

    def over(self, others: Figures) -> Figures:
        """Ratios to the figures of the same rounds."""
        return Figures([a / b for a, b in zip(self.values, others.values, strict=True)])

    def as_json(self) -> dict[str, Any]:
        """Return all for JSON."""
        values = list(self.values)
        return {"median": self.median, "low": min(values), "high": max(values), "values": values}


def memory_bytes(pids: Sequence[int]) -> int:
    """Return the memory of the processes, with shared memory divided among its users."""
    return sum(map(_memory_bytes, pids))


def _memory_bytes(pid: int) -> int:
    for line in _read(f"/proc/{pid}/smaps_rollup").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    return 0


def family(pid: int) -> Iterator[int]:
    """Yield the ids of a process and of its descendants."""
    yield pid
    for of_thread in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in _read(str(of_thread)).split():
            yield from family(int(child))


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
