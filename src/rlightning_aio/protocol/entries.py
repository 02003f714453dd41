"""Entries: identify a request, and the reply to it.

An entry is an int64 of the number of the request, the slot of its env in the group, and the
operation. A reply repeats the entry of its request, so a late reply is found by comparison. 0 is
no entry.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Operation(IntEnum):
    """The kind of a request.

    Invariant: RESET == STEP + 1, so that a batch of steps becomes resets by adding a mask.
    """

    STEP = 1
    RESET = 2
    CALL = 3
    """Calls a method; the reply is its value."""
    SNAPSHOT = 4
    """The reply is the state of the env."""
    RESTORE = 5
    """A reset to a saved state; the reply is the last result of that time."""


RENEW: Final = "_rlightning_aio_renew"
"""A call of this name has an env rebuilt for its next request; hardware stays as it is."""
_WITH_VALUE: Final = (Operation.CALL, Operation.SNAPSHOT)
ANSWERS_WITH_VALUE: Final = np.isin(np.arange(max(Operation) + 1), _WITH_VALUE)
"""By operation, True if the reply to it is a value, not a result in a row."""
OP_BITS: Final = 8
SLOT_BITS: Final = 20
NUMBER_SHIFT: Final = OP_BITS + SLOT_BITS
SLOT_MASK: Final = (1 << SLOT_BITS) - 1
OP_MASK: Final = (1 << OP_BITS) - 1

# 0-d arrays for columns of entries: NumPy takes twice as long over a Python int.
WITHOUT_OP: Final = np.array(~OP_MASK)
OP_BITS_ARRAY: Final = np.array(OP_BITS)
SLOT_MASK_ARRAY: Final = np.array(SLOT_MASK)


def entry(number: int, slot: int, op: int) -> int:
    """Make an entry."""
    return (number << NUMBER_SHIFT) | (slot << OP_BITS) | op


def answers_with_value(op: int) -> bool:
    """Return True if the reply to an operation is a value, not a result in a row."""
    return op in _WITH_VALUE  # Faster than an element of the array.


def number_of(entry: int) -> int:
    """Number of the request of an entry."""
    return entry >> NUMBER_SHIFT


def slot_of(entry: int) -> int:
    """Slot of the env of an entry."""
    return (entry >> OP_BITS) & SLOT_MASK


def slots_of(entries: NDArray[np.int64]) -> NDArray[np.int64]:
    """Slots of the envs of a column of entries."""
    return (entries >> OP_BITS_ARRAY) & SLOT_MASK_ARRAY


def op_of(entry: int) -> int:
    """`Operation` of an entry."""
    return entry & OP_MASK
