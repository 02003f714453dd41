"""`FirstObservations`: warns once per config entry if its observations exceed their space."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol.bounds import out_of_bounds
from rlightning_aio.trees import index

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["FirstObservations"]

_NUM_CHECKED: Final = 10


class FirstObservations:
    """Checks one observation per entry in each of the first batches that contain the entry.

    Observations are returned unchanged, so code that scales them by the bounds of their space must
    know if the simulator exceeds these. Members are skipped: their observations say nothing about a
    task, and must not raise an error in a trainer that turns warnings into errors.

    Attributes:
        left: the number of checks left for each entry, by its number; empty when all are done.
    """

    def __init__(self, envs: EnvTable) -> None:
        self._envs = envs
        self.left = dict.fromkeys(range(len(envs.names.entry_names)), _NUM_CHECKED)

    def check(self, parts: Iterable[ResultColumns]) -> None:
        """Check observations of a batch, and warn of those that exceed their space."""
        for part in parts:
            entries = part.names.entries[part.slots]
            for entry in list(self.left):
                rows = np.flatnonzero(entries == entry)
                if len(rows):
                    self._check_row(part, int(rows[0]), entry)

    def _check_row(self, part: ResultColumns, row: int, entry: int) -> None:
        slot: int = part.slots.item(row)
        spaces = self._envs.observation_spaces
        space = spaces[slot] if slot < len(spaces) else None
        problem = None
        if space is not None:
            problem = out_of_bounds(space, _observation_of(part, row), "an observation")
        self.left[entry] -= 1
        if problem or not self.left[entry]:
            del self.left[entry]
        if problem:
            warnings.warn(
                f"{self._envs.describe(slot)}: {problem}; it is passed on unchanged, so don't "
                "rely on the bounds of this task's observations",
                stacklevel=2,
            )


def _observation_of(part: ResultColumns, row: int) -> Any:
    """The observation of a row; None if it is still pickled, as unpickling may fail."""
    if isinstance(part.out_of_band.get(row), bytes):
        return None if part.observation is None else index(part.observation, row)
    return part.observation_of(row)
