"""How a wished number of simulations is laid over the cores."""

from __future__ import annotations

import os
from typing import Final

__all__ = ["num_batches", "num_cores"]

_AS_GOOD: Final = 1.15
"""So many times the best share of a core, and batches may be fewer and larger."""


def num_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


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
