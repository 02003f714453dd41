"""Resets of several simulations together, with the noise that Gymnasium would draw.

Each simulation draws from its own generator, in Gymnasium's order, so the numbers are the same.
Only tasks that draw positions and velocities around the first ones can do this (`Task.noise`).
"""

from __future__ import annotations

import ctypes
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.envs.mujoco.outputs import Noise, address_of, compiled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


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


def noise_of(env: Any, kind: str, generators: NDArray[np.uintp]) -> Noise | None:
    """Return what the compiled function draws, the same as `drawn`; None if it can't.

    Args:
        env: the unwrapped Gymnasium env.
        kind: see `drawn`.
        generators: of each simulation, where they are in memory.
    """
    draw = _normal() if kind == "normal" else 0
    states = (env.init_qpos, env.init_qvel)
    plain = all(each.dtype == np.float64 and each.flags.c_contiguous for each in states)
    if compiled() is None or draw is None or not plain or not _uniform_is_product():
        return None
    scale = env._reset_noise_scale  # noqa: SLF001
    return Noise(address_of(generators), draw or None, scale, *map(address_of, states))


def generator_of(generator: np.random.Generator) -> int:
    """Address of the C functions of a generator, which must be kept meanwhile."""
    return generator.bit_generator.ctypes.bit_generator.value


@cache
def _normal() -> int | None:
    """Address of NumPy's C function that draws a normal number; None where it isn't exported."""
    try:
        library = ctypes.CDLL(import_module("numpy.random._generator").__file__)
        return ctypes.cast(library.random_standard_normal, ctypes.c_void_p).value
    except (AttributeError, OSError):
        return None


@cache
def _uniform_is_product() -> bool:
    """Return True if NumPy rounds a draw from an interval as arrays do; not where it fuses."""
    ours, theirs = np.random.default_rng(0), np.random.default_rng(0)
    low, high = -0.1, 0.1
    return np.array_equal(low + (high - low) * ours.random(1000), theirs.uniform(low, high, 1000))
