"""Resets of several simulations together, with the noise that Gymnasium would draw.

Each simulation draws from its own generator, in Gymnasium's order, so the numbers are the same.
Only tasks that draw positions and velocities around the first ones can do this (`Task.noise`).
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["can_draw", "drawn"]


def can_draw(scale: Any) -> bool:
    """Return True if `drawn` takes this scale; Gymnasium refuses some others."""
    return isinstance(scale, int | float) and 0 <= scale < 1e300


def drawn(
    generators: Sequence[np.random.Generator], kind: str, scale: float, nq: int, nv: int
) -> NDArray[np.float64]:
    """Draw noise of positions and velocities, ``[len(generators), nq + nv]``.

    Args:
        generators: of the simulations.
        kind: of the velocities' noise, see `Task.noise`.
        scale: the bound of uniform noise, and the deviation of normal noise.
        nq: number of positions.
        nv: number of velocities.
    """
    width, is_product = nq if kind == "normal" else nq + nv, _uniform_is_product()
    noise = np.empty((len(generators), nq + nv))
    uniform, normal = noise[:, :width], noise[:, width:]
    if kind != "normal":
        normal = [None] * len(noise)
    for generator, first, second in zip(generators, uniform, normal, strict=True):
        if is_product:
            generator.random(out=first)
        else:
            first[:] = generator.uniform(-scale, scale, width)
        if second is not None:
            generator.standard_normal(out=second)
    if is_product:
        uniform *= scale - -scale
        uniform += -scale
    if kind == "normal":
        noise[:, width:] *= scale
    return noise


@cache
def _uniform_is_product() -> bool:
    """Return True if NumPy rounds a draw from an interval as arrays do; not where it fuses."""
    ours, theirs = np.random.default_rng(0), np.random.default_rng(0)
    low, high = -0.1, 0.1
    return np.array_equal(low + (high - low) * ours.random(1000), theirs.uniform(low, high, 1000))
