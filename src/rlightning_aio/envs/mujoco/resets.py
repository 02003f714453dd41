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

__all__ = ["Some", "can_draw", "drawn"]


class Some:
    """The fields of some simulations, by MuJoCo's names: copies ``[len(ids), ...]``."""

    def __init__(self, simulations: Any, ids: NDArray[np.intp]) -> None:
        self._simulations, self._ids = simulations, ids

    def __getattr__(self, name: str) -> NDArray[Any]:
        return getattr(self._simulations, name)[self._ids]

    def model_field(self, name: str) -> NDArray[Any]:
        """A field of the model: ``[len(ids), ...]`` if simulations differ in it."""
        return self._simulations.model_field(name, self._ids)


def can_draw(scale: Any) -> bool:
    """Return True if `drawn` takes this scale; Gymnasium refuses some others."""
    return isinstance(scale, int | float) and 0 <= scale < 1e300


def drawn(
    generators: Sequence[np.random.Generator], kind: str, scale: float, nq: int, nv: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw noise of positions and velocities, ``[len(generators), nq]`` and ``[..., nv]``.

    Args:
        generators: of the simulations.
        kind: of the velocities' noise, see `Task.noise`.
        scale: the bound of uniform noise, and the deviation of normal noise.
        nq: number of positions.
        nv: number of velocities.
    """
    count, is_normal = len(generators), kind == "normal"
    uniform = np.empty((count, nq if is_normal else nq + nv))
    normal = np.empty((count, nv))
    is_product = _uniform_is_product()
    for k, generator in enumerate(generators):
        if is_product:
            generator.random(out=uniform[k])
        else:
            uniform[k] = generator.uniform(-scale, scale, uniform.shape[1])
        if is_normal:
            generator.standard_normal(out=normal[k])
    if is_product:
        uniform = -scale + (scale - -scale) * uniform
    if is_normal:
        return uniform, scale * normal
    return uniform[:, :nq], uniform[:, nq:]


@cache
def _uniform_is_product() -> bool:
    """Return True if NumPy rounds a draw from an interval as arrays do; not where it fuses."""
    ours, theirs = np.random.default_rng(0), np.random.default_rng(0)
    low, high = -0.1, 0.1
    return np.array_equal(low + (high - low) * ours.random(1000), theirs.uniform(low, high, 1000))
