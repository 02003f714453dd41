"""`Arrivals`: envs that join a group, or come back to it, while it runs.

An env joins with a first result that answers no request; or it answers the response that was
withdrawn because the env was away. Responses to envs that have left are dropped. Left out: the
hosts of such envs, which `Members` lists.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rlightning_aio._core.group.engine.actions import response_columns
from rlightning_aio.batch.contents import names_of
from rlightning_aio.batch.data import BatchedData

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.messages import Joined

__all__ = ["Arrivals"]


class Arrivals:
    """See the module; the arguments are the group's parts.

    Attributes:
        held_back: by slot, envs that came back before the result that reports their loss was
            collected; see `admit`.
        asked: slots of the last batch of responses; back: those of them that `drop_gone` has
            dropped, because their first results answer them.
    """

    def __init__(self, tables: Tables, results: Results) -> None:
        self._envs = tables.envs
        self._requests = tables.requests
        self._layout = tables.layout
        self._episodes = tables.episodes
        self._results = results
        self.held_back: dict[int, Joined] = {}
        self._withdrawn: set[int] = set()
        self.asked = self.back = np.zeros(0, np.intp)

    def join(self, completion: Joined, first_slot: int, now: float) -> None:
        """Record that an env joined a host, and keep its first result for the collector.

        Args:
            completion: from the host.
            first_slot: of the host.
            now: monotonic seconds.
        """
        slot = first_slot + completion.env_index
        if completion.slab is not None:
            self._layout.add(completion.slab, first_slot)
        if not self._requests.is_idle(slot):
            self.held_back[slot] = completion
            return
        self._accept(completion, slot, now)

    def _accept(self, completion: Joined, slot: int, now: float) -> None:
        meta, first_slot = completion.meta, slot - completion.env_index
        if self._envs.env_ids[slot] not in ("", meta.env_id):
            self._withdrawn.discard(slot)
        has_row = self._layout.of(slot)[0].action is not None
        self._envs.note_joined(slot, first_slot, meta, completion.traits, has_row=has_row)
        self._episodes.note_joined(slot)
        self._requests.join(slot, now)
        if slot in self._withdrawn:
            # This result answers the response that the env was away for.
            self._withdrawn.discard(slot)
        else:
            self._results.note_unasked(self._requests.alone(slot))
        self._results.keep(slot, completion.write() or {})

    def admit(self, slots: NDArray[np.intp], now: float) -> None:
        """Accept envs that came back to those of `slots` whose rows are free now."""
        for slot in slots.tolist():
            if slot in self.held_back and self._requests.is_idle(slot):
                self._accept(self.held_back.pop(slot), slot, now)

    def withdraw(self, slot: int) -> None:
        """End a request of the collector to an env that is away: its next first result answers."""
        self._requests.withdraw(slot)
        self._withdrawn.add(slot)

    def drop_gone(
        self, batch: BatchedData, slots: NDArray[np.intp]
    ) -> tuple[BatchedData, NDArray[np.intp]]:
        """Drop the responses to envs that have left since `batch` was returned.

        Such an env is back, or another has its slot. The response was meant for the episode that
        was lost. The first result of an env that is back, which waits to be collected, answers it.
        """
        self.asked, self.back = slots, slots[:0]
        names, is_current = self._envs.names, names_of(batch) is self._envs.names
        if is_current and not self._requests.collector.num_ready:
            return batch, slots
        gone = back = self._requests.joined(slots)
        if not is_current:
            pairs = zip(batch.env_ids(), names.ids(slots), strict=True)
            is_other = np.array([then != now for then, now in pairs], np.bool_)
            gone, back = gone | is_other, back & ~is_other
        if not gone.any():
            return batch, slots
        if back.any():
            self.back = slots[back]
            columns = response_columns(_chosen(batch, back), self.back, self._layout)
            self._results.note_sent(self.back, columns)
        return _chosen(batch, ~gone), slots[~gone]


def _chosen(batch: BatchedData, which: NDArray[np.bool_]) -> BatchedData:
    """Return a batch of the responses that `which` marks."""
    env_ids, values = batch.env_ids(), batch.values()
    chosen = np.flatnonzero(which).tolist()
    return BatchedData([env_ids[k] for k in chosen], [values[k] for k in chosen])
