"""What a sample of episodes says of a policy: estimates with 95 % confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Estimate", "mean_estimate", "wilson_estimate"]

_Z: Final = NormalDist().inv_cdf(0.975)
_T: Final = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""The 97.5 % quantiles of Student's t with 1 to 10 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean and where the true one lies, with 95 % confidence.

    Attributes:
        mean: of the sample.
        low, high: ends of the interval; None where one value says nothing of the spread.
        count: values in the sample.
    """

    mean: float
    low: float | None
    high: float | None
    count: int


def mean_estimate(values: Sequence[float]) -> Estimate | None:
    """The mean of `values` with Student's t interval; None if there are none."""
    if not values:
        return None
    mean, count = fmean(values), len(values)
    if count == 1:
        return Estimate(mean, None, None, 1)
    half = _student_quantile(count - 1) * stdev(values) / math.sqrt(count)
    return Estimate(mean, mean - half, mean + half, count)


def wilson_estimate(successes: int, count: int) -> Estimate | None:
    """The share of `successes` among `count` trials with Wilson's score interval.

    It stays within 0 and 1, and is an interval also where all or none succeed. None if there
    are no trials.
    """
    if not count:
        return None
    share, z2 = successes / count, _Z * _Z
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    spread = math.sqrt(share * (1 - share) / count + z2 / (4 * count * count))
    half = _Z * spread / (1 + z2 / count)
    # At the ends the sums are exactly 0 and 1, but for rounding.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == count else middle + half
    return Estimate(share, low, high, count)


def _student_quantile(freedom: int) -> float:
    """The 97.5 % quantile of Student's t: from a table, then by its expansion (to 0.0002)."""
    if freedom <= len(_T):
        return _T[freedom - 1]
    z, n = _Z, freedom
    return (
        z
        + (z**3 + z) / (4 * n)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    )
