"""`FirstLooks`: says of each config entry, once, that its observations exceed their space."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol.bounds import out_of_bounds
from rlightning_aio.protocol.columns import index

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.group.env_table import EnvTable

__all__ = ["FirstLooks"]

_LOOKS: Final = 10


class FirstLooks:
    """Looks at one result of each entry in each of the first batches that have any.

    Observations are handed out as they are. Whoever scales them by the bounds of their space
    should know that the simulator doesn't keep to these. Clients are left out: what they send says
    nothing of a task, and shall set nothing off in a trainer that makes errors of warnings.

    Attributes:
        left: how many looks are left of each entry, by its number; empty once all is seen.
    """

    def __init__(self, envs: EnvTable) -> None:
        self._envs = envs
        self.left = dict.fromkeys(range(len(envs.names.entry_names)), _LOOKS)

    def look(self, parts: Iterable[ResultColumns]) -> None:
        """Look at a batch's parts, and warn."""
        for part in parts:
            entries = part.names.entries[part.slots]
            for entry in list(self.left):
                rows = np.flatnonzero(entries == entry)
                if len(rows):
                    self._look_at(part, int(rows[0]), entry)

    def _look_at(self, part: ResultColumns, row: int, entry: int) -> None:
        slot: int = part.slots.item(row)
        spaces = self._envs.observation_spaces
        space = spaces[slot] if slot < len(spaces) else None
        said = None
        if space is not None:
            said = out_of_bounds(space, _observation_of(part, row), "an observation")
        self.left[entry] -= 1
        if said or not self.left[entry]:
            del self.left[entry]
        if said:
            warnings.warn(
                f"{self._envs.describe(slot)}: {said}; it is passed on unchanged, so don't rely on "
                "the bounds of this task's observations",
                stacklevel=2,
            )


def _observation_of(part: ResultColumns, row: int) -> Any:
    """None where it is still pickled, and may not come out."""
    if isinstance(part.out_of_band.get(row), bytes):
        return None if part.observation is None else index(part.observation, row)
    return part.observation_of(row)
