"""`Randomizer`: MuJoCo model fields that differ between simulations, drawn at each reset.

Rule: a field of a simulation is the value of the model times one factor, drawn uniformly from a
range by a generator of the simulation, seeded by its seed. Gymnasium's generator is not used, so
the rest of a reset doesn't change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.envs.mujoco.threads import Simulations

__all__ = ["Randomizer"]

_STREAM: Final = 0x7261_6E64
"""Distinguishes this generator from Gymnasium's, which has the same seed."""
_TRIAL: Final = 1.0625


class Randomizer:
    """Factors of some fields of some simulations.

    Args:
        simulations: made with `own_models`.
        ranges: the lowest and the highest factor of each field, by its name in `MjModel`, or
            ``opt.<name>`` as in `MjOption`.

    Raises:
        ConfigError: a field is unknown, can't differ, or follows from others; or a range is
            invalid.
    """

    def __init__(self, simulations: Simulations, ranges: Mapping[str, Any]) -> None:
        if not isinstance(ranges, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ConfigError(f"randomize must map fields to ranges, not be {ranges!r}")
        self._simulations = simulations
        self._ranges = {name: _range_of(name, given) for name, given in ranges.items()}
        self._values: dict[str, NDArray[Any]] = {}
        for name in self._ranges:
            try:
                self._values[name] = simulations.expand(name)
            except AttributeError as error:
                raise ConfigError(f"randomize.{name}: {error}") from None
        self._nominal = {name: values[0].copy() for name, values in self._values.items()}
        for name in self._values:
            self._check_kept(name)
        self._generators = [np.random.default_rng() for _ in range(simulations.count)]

    def _check_kept(self, name: str) -> None:
        """Refuse a field that MuJoCo computes from others, so that a factor has no effect."""
        first, nominal = np.array([0], np.int32), self._nominal[name]
        self._values[name][0] = nominal * _TRIAL
        self._simulations.set_const(first)
        is_kept = np.array_equal(self._values[name][0], nominal * _TRIAL)
        self._values[name][0] = nominal
        self._simulations.set_const(first)
        if not is_kept:
            raise ConfigError(
                f"randomize.{name}: MuJoCo computes this field from others; randomize those"
            )

    def draw(self, k: int, seed: int | None) -> dict[str, float]:
        """Draw new fields for simulation `k`. Call `Simulations.set_const` afterwards.

        Args:
            k: position of the simulation.
            seed: for its generator; None continues with the current one.

        Returns:
            The factors by field.
        """
        if seed is not None:
            self._generators[k] = np.random.default_rng([_STREAM, seed])
        factors: dict[str, float] = {}
        for name, (low, high) in self._ranges.items():
            factors[name] = factor = self._generators[k].uniform(low, high)
            self._values[name][k] = self._nominal[name] * factor
        return factors

    def save_state(self) -> Any:
        """Return ranges, generators and fields."""
        fields = {name: values.copy() for name, values in self._values.items()}
        return self._ranges, self._generators, fields

    def check_fits(self, state: Any) -> None:
        """Raise `ValueError` if a state is not that of simulations with the same ranges."""
        ranges = None if state is None else state[0]
        if ranges != self._ranges:
            raise ValueError(
                f"randomize of the snapshot's simulations is {ranges}, and here {self._ranges}"
            )

    def load_state(self, state: Any) -> None:
        """Restore what `save_state` returned, if it fits."""
        _, self._generators, fields = state
        for name, values in self._values.items():
            values[:] = fields[name]
        self._simulations.set_const()


def _range_of(name: str, given: Any) -> tuple[float, float]:
    if name == "opt.timestep":
        raise ConfigError("randomize.opt.timestep: rewards assume that all have one time step")
    if isinstance(given, Sequence) and not isinstance(given, str):
        bounds = list(cast("Sequence[Any]", given))
        if len(bounds) == 2 and all(type(bound) in (int, float) for bound in bounds):
            low, high = bounds
            if low <= high and math.isfinite(low) and math.isfinite(high):
                return low, high
    raise ConfigError(
        f"randomize.{name} is {given!r}, but must be [lowest, highest] factor of the model's value"
        ", and finite"
    )
