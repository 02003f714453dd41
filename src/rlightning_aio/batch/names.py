"""`EnvNames`: ids and config entries of the envs of a group, for batches; they never change."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class EnvNames:
    """Names of envs, by slot.

    Attributes:
        env_ids: id of each env.
        entries: number of the config entry of each slot; entry_names: names of the entries.
        index_offset: position in the group of the first sub-environment of each slot.
    """

    env_ids: Sequence[str]
    entries: NDArray[np.intp]
    entry_names: Sequence[str]
    index_offset: NDArray[np.int64]

    def ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots`, in order."""
        chosen: list[int] = slots.tolist()
        return [self.env_ids[slot] for slot in chosen]

    def names(self, slots: NDArray[np.intp]) -> list[str]:
        """Config entries of `slots`, in order."""
        chosen: list[int] = self.entries[slots].tolist()
        return [self.entry_names[entry] for entry in chosen]

    def of(self, slots: NDArray[np.intp]) -> EnvNames:
        """Select `slots`, which become slots 0, 1, 2, …"""
        return replace(
            self,
            env_ids=self.ids(slots),
            entries=self.entries[slots],
            index_offset=self.index_offset[slots],
        )
