"""Estimates from a sample of episodes, with 95 % confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

_Z: Final = NormalDist().inv_cdf(0.975)
_T: Final = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""The 97.5 % quantiles of Student's t with 1 to 10 degrees of freedom."""
_SHOWN_DIGITS: Final = 2
"""Of half of an interval, where an estimate is printed."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean with its 95 % confidence interval.

    Attributes:
        mean: of the sample.
        low, high: bounds of the interval; None if the values don't determine it.
        count: number of values in the sample.
    """

    mean: float
    low: float | None
    high: float | None
    count: int

    def __str__(self) -> str:
        """Return ``mean [low, high] (n=count)``, with as many digits as the interval determines."""
        if self.low is None or self.high is None:
            return f"{self.mean:.4g} (n={self.count})"
        half = (self.high - self.low) / 2
        known = 0.0 < half < math.inf
        digits = max(0, _SHOWN_DIGITS - 1 - math.floor(math.log10(half))) if known else 2
        mean, low, high = (f"{value:.{digits}f}" for value in (self.mean, self.low, self.high))
        return f"{mean} [{low}, {high}] (n={self.count})"


def mean_estimate(values: Sequence[float]) -> Estimate | None:
    """Mean of `values`, which are finite, with Student's t interval; None without values."""
    if not values:
        return None
    count = len(values)
    # Scaling by a power of two is exact, and keeps the sum of large values finite.
    _, exponent = math.frexp(max(map(abs, values)))
    scaled = [math.ldexp(value, -exponent) for value in values]
    mean = fmean(scaled)
    if count == 1:
        return Estimate(values[0], None, None, 1)
    half = _student_quantile(count - 1) * stdev(scaled) / math.sqrt(count)
    low, middle, high = (_grown(value, exponent) for value in (mean - half, mean, mean + half))
    return Estimate(middle, low, high, count)


def _grown(value: float, exponent: int) -> float:
    """Return ``value * 2**exponent``, or infinity on overflow."""
    try:
        return math.ldexp(value, exponent)
    except OverflowError:
        return math.copysign(math.inf, value)


def wilson_estimate(successes: int, count: int) -> Estimate | None:
    """Share of `successes` in `count` trials with Wilson's score interval; None without trials.

    The interval stays within 0 and 1, and has a width even if all or none succeed.
    """
    if not count:
        return None
    share, z2 = successes / count, _Z * _Z
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    spread = math.sqrt(share * (1 - share) / count + z2 / (4 * count * count))
    half = _Z * spread / (1 + z2 / count)
    # Avoids rounding errors where the exact bounds are 0 and 1.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == count else middle + half
    return Estimate(share, low, high, count)


def _student_quantile(freedom: int) -> float:
    """97.5 % quantile of Student's t: from a table, then by its expansion (error 0.0002)."""
    if freedom <= len(_T):
        return _T[freedom - 1]
    z, n = _Z, freedom
    return (
        z
        + (z**3 + z) / (4 * n)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    )
