"""`Resumption`: where the envs of a dead worker go on, and how many steps they have lost.

An env of an entry with ``snapshot_every`` sends its standing by itself. A standing that was sent
during a request counts once that request is answered: until then, nobody knows what the env did.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.group.requests import State
from rlightning_aio.protocol.slab import AS_RESTORED, NO_SEED

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rlightning_aio.group.requests import Requests

__all__ = ["Resumption"]


@dataclass(slots=True)
class _Standing:
    """A standing, and the number of the last request that it knows of.

    Of calls, which are no steps, the number is shifted by those that came since.
    """

    content: bytes
    entry: int
    number: int


class Resumption:
    """The standings of a group's envs by slot; empty where no entry asks for them."""

    def __init__(self, requests: Requests) -> None:
        self._requests = requests
        self._good: dict[int, _Standing] = {}
        self._new: dict[int, _Standing] = {}
        # Steps lost, of those whose next reply shows where they stand.
        self._showing: dict[int, int] = {}

    def note_saved(self, slot: int, content: bytes, *, before: bool) -> None:
        """The env of `slot` has given its standing away in its current request, which it has
        executed, or is about to if it is `before`.
        """
        number = self._requests.number(slot)
        earlier = self._new.pop(slot, None)
        if before:
            self._good[slot] = _Standing(content, 0, number - 1)
            return
        if earlier is not None:
            self._good[slot] = earlier
        self._new[slot] = _Standing(content, int(self._requests.entry[slot]), number)

    def note_no_step(self, slots: Iterable[int]) -> None:
        """Requests that are no steps are about to be sent to `slots`."""
        for standings in (self._good, self._new) if self._good or self._new else ():
            for slot in slots:
                if slot in standings:
                    standings[slot].number += 1

    def settle(self, slots: Iterable[int]) -> None:
        """The envs of `slots` are gone: what came with a request that wasn't answered is, too."""
        for slot in slots:
            new = self._new.pop(slot, None)
            if new is None:
                continue
            busy = self._requests.state[slot] == State.BUSY
            if not (busy and self._requests.entry[slot] == new.entry):
                self._good[slot] = new

    def standings(self, slots: Iterable[int]) -> tuple[bytes | None, ...]:
        """Where the envs of a replacement are to stand; None for one that begins anew."""
        return tuple(self._good[slot].content if slot in self._good else None for slot in slots)

    def seeds(
        self, slots: NDArray[np.intp], stepped: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], dict[int, int]]:
        """What resets are to be sent with, to `slots` whose worker was replaced.

        Args:
            slots: whose replacements are asked.
            stepped: which of them were asked for a step, or are about to be. The others begin an
                episode, unless they have been asked to show where they stand before.

        Returns also, by slot, how many steps those have lost that show where they stand.
        """
        seeds = np.full(len(slots), NO_SEED)
        for k, (slot, was_step) in enumerate(zip(slots.tolist(), stepped.tolist(), strict=True)):
            if slot in self._good and (was_step or slot in self._showing):
                seeds[k] = AS_RESTORED
                self._showing.setdefault(slot, self._lost(slot))
        return seeds, {slot: self._showing[slot] for slot in slots[seeds == AS_RESTORED].tolist()}

    def _lost(self, slot: int) -> int:
        """Steps that were answered and that the env knows nothing of any more."""
        owes = self._requests.state[slot] == State.BUSY
        return max(self._requests.number(slot) - int(owes) - self._good[slot].number, 0)

    def told(self, slot: int) -> int | None:
        """A replacement has replied; how many steps it has lost, if it shows where it stands."""
        lost = self._showing.pop(slot, None)
        if lost is not None:
            self._good[slot].number = self._requests.number(slot)
        return lost

    def forget(self, slots: Any) -> None:
        """The envs of `slots` are gone for good."""
        for slot in slots:
            for known in (self._good, self._new, self._showing):
                known.pop(slot, None)
