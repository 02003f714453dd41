"""How a wished number of simulations is laid over the cores."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Final

__all__ = ["num_batches", "num_cores"]

_AS_GOOD: Final = 1.15
"""So many times the best share of a core, and batches may be fewer and larger."""

_CGROUPS: Final = Path("/sys/fs/cgroup")


def num_cores(cgroups: Path = _CGROUPS) -> int:
    """How many cores this process may keep busy: by its affinity, and by its container's limit.

    Args:
        cgroups: where the kernel tells of limits on processor time, which Docker and Kubernetes
            set (https://docs.kernel.org/admin-guide/cgroup-v2.html, ``cpu.max``).
    """
    cores, limit = len(os.sched_getaffinity(0)), _time_limit(cgroups)
    return cores if limit is None else max(1, min(cores, math.ceil(limit)))


def _time_limit(cgroups: Path) -> float | None:
    """Seconds of processor time in a second, if they are limited."""
    try:
        if (cgroups / "cpu.max").exists():
            quota, period = (cgroups / "cpu.max").read_text().split()
        else:  # Version 1.
            quota = (cgroups / "cpu" / "cpu.cfs_quota_us").read_text()
            period = (cgroups / "cpu" / "cpu.cfs_period_us").read_text()
        limit = int(quota) / int(period)
    except (OSError, ValueError):  # Nothing is told, or "max".
        return None
    return limit if limit > 0 else None


def num_batches(total: int, num_workers: int) -> int:
    """In how many batches of equal size `num_workers` step `total` simulations best.

    One for each worker where that goes without a rest. Else the fewest with which no worker has
    much more than its share: 100 simulations over 16 workers make 25 batches of 4, of which a
    worker has one or two.
    """
    best = -(-total // num_workers)
    for count in range(1, total + 1):
        if total % count == 0 and -(-count // num_workers) * (total // count) <= _AS_GOOD * best:
            return count
    return total
