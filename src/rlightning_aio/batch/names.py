"""`EnvNames`: who the envs of a group are, as batches know them.

Rule: it never changes. When a client takes another's place, the group gets a new one, and batches
that were returned before keep the names that were true of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

__all__ = ["EnvNames"]


@dataclass(frozen=True, slots=True)
class EnvNames:
    """Names of envs, by slot.

    Attributes:
        env_ids: of each; empty for a slot that no client has taken.
        shared_ids: what a batch calls them: a client goes by its env_server's id.
        entries: number of each one's config entry; entry_names: their names.
        index_offset: sub-environments of the group before each slot's.
        turns: whether results of a slot come from some of its sub-environments at a time.
    """

    env_ids: Sequence[str]
    shared_ids: Sequence[str]
    entries: NDArray[np.intp]
    entry_names: Sequence[str]
    index_offset: NDArray[np.int64]
    turns: NDArray[np.bool_]

    def ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots`, in order."""
        chosen: list[int] = slots.tolist()
        return [self.env_ids[slot] for slot in chosen]

    def batch_ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots` as a batch has them."""
        chosen: list[int] = slots.tolist()
        return [self.shared_ids[slot] for slot in chosen]

    def names(self, slots: NDArray[np.intp]) -> list[str]:
        """Config entries of `slots`, in order."""
        chosen: list[int] = self.entries[slots].tolist()
        return [self.entry_names[entry] for entry in chosen]

    def of(self, slots: NDArray[np.intp]) -> EnvNames:
        """Those of `slots` alone, which are slots 0, 1, 2, … of it."""
        return replace(
            self,
            env_ids=self.ids(slots),
            shared_ids=self.batch_ids(slots),
            entries=self.entries[slots],
            index_offset=self.index_offset[slots],
            turns=self.turns[slots],
        )

    def renamed(self, slot: int, env_id: str, index_offset: int) -> EnvNames:
        """The same with another env in `slot`."""
        env_ids, offsets = list(self.env_ids), self.index_offset.copy()
        env_ids[slot], offsets[slot] = env_id, index_offset
        return replace(self, env_ids=env_ids, index_offset=offsets)
