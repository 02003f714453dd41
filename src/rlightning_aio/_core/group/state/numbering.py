"""`Numbering`: the number and the operation of each slot's current request."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio.protocol.entries import (
    ANSWERS_WITH_VALUE,
    NUMBER_SHIFT,
    OP_BITS,
    OP_MASK,
    WITHOUT_OP,
    Operation,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OP: Final = np.array(OP_MASK)
_NEXT: Final = {op: np.array((1 << NUMBER_SHIFT) + op) for op in map(int, Operation)}
"""Numbers to add to an entry without an operation."""


class Numbering:
    """The number and the operation of each slot's current request, or its last.

    Attributes:
        entry: number, slot and operation, by slot.
    """

    def __init__(self, size: int) -> None:
        self.entry = np.arange(size) << OP_BITS

    def number(self, slot: int) -> int:
        """Number of the current request; 0 before the first."""
        return int(self.entry[slot]) >> NUMBER_SHIFT

    def op(self, slot: int) -> int:
        """Operation of the current request; 0 before the first."""
        return int(self.entry[slot]) & OP_MASK

    def ops(self, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """Operations of the current requests of `slots`."""
        return self.entry[slots] & _OP

    def awaits_value(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which of `slots` have requests that are answered by a value, not a result."""
        return ANSWERS_WITH_VALUE[self.ops(slots)]

    def renew(self, slots: NDArray[np.intp], op: int) -> NDArray[np.int64]:
        """Number the next request of each of `slots`, and return their entries."""
        if len(slots) == 1:  # As most results come one by one: in a third of the time.
            slot = slots.item()
            self.entry[slot] = (self.entry.item(slot) & ~OP_MASK) + (1 << NUMBER_SHIFT) + op
            return self.entry[slots]
        entries = self.entry[slots]
        entries &= WITHOUT_OP
        entries += _NEXT[op]
        self.entry[slots] = entries
        return entries

    def into_resets(
        self, slots: NDArray[np.intp], entries: NDArray[np.int64], which: NDArray[np.bool_]
    ) -> None:
        """Make resets of those steps, issued and not yet handed over, that `which` marks."""
        entries += which  # RESET == STEP + 1
        self.entry[slots] = entries
