"""The number of cores and threads, and the division of simulations into batches for them."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Final

from rlightning_aio.errors import ConfigError

_AS_GOOD: Final = 1.15
"""A worker may have this many times its share if that makes batches fewer and larger."""

_CGROUPS: Final = Path("/sys/fs/cgroup")


def num_cores(cgroups: Path = _CGROUPS) -> int:
    """Number of cores that this process may use, by its affinity and its container's limit.

    Args:
        cgroups: folder with the kernel's limits on processor time, as set by Docker and Kubernetes
            (https://docs.kernel.org/admin-guide/cgroup-v2.html, ``cpu.max``).
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    limit = _time_limit(cgroups)
    return cores if limit is None else max(1, min(cores, math.ceil(limit)))


def _time_limit(cgroups: Path) -> float | None:
    """Seconds of processor time per second; None without a limit."""
    try:
        if (cgroups / "cpu.max").exists():
            quota, period = (cgroups / "cpu.max").read_text().split()
        else:  # Version 1.
            quota = (cgroups / "cpu" / "cpu.cfs_quota_us").read_text()
            period = (cgroups / "cpu" / "cpu.cfs_period_us").read_text()
        limit = int(quota) / int(period)
    except (OSError, ValueError):  # Without a limit: no file, or "max".
        return None
    return limit if limit > 0 else None


def check_threads(name: str, number: Any) -> None:
    """Check a number of threads that a user gave as `name`; None leaves the choice to us.

    Raises:
        ConfigError: it is no int above 0.
    """
    if number is not None and (type(number) is not int or number < 1):
        raise ConfigError(f"{name} is {number!r}, but must be an int above 0")


def num_batches(total: int, num_workers: int) -> int:
    """Best number of equal batches for `total` simulations on `num_workers` workers.

    One for each worker if that divides `total`; else the smallest number at which no worker has
    much more than its share: 100 simulations on 16 workers make 25 batches of 4, one or two for
    each worker.
    """
    best = -(-total // num_workers)
    for count in range(1, total + 1):
        if total % count == 0 and -(-count // num_workers) * (total // count) <= _AS_GOOD * best:
            return count
    return total
