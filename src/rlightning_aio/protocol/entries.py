"""Entries: how one request, and the reply to it, is named everywhere.

An entry is one int64: the request's number, the slot of its env in the group, and the
operation. A reply repeats the entry of its request, so a comparison of the two tells
whether it is late. An entry of 0 stands for none.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

__all__ = [
    "NUMBER_SHIFT",
    "OP_BITS",
    "OP_MASK",
    "SLOT_MASK",
    "Operation",
    "answers_with_value",
    "entry",
    "number_of",
    "op_of",
    "slot_of",
]


class Operation(IntEnum):
    """What an env can be asked for.

    Invariant: RESET == STEP + 1, so that a batch of steps becomes resets by adding a mask.
    """

    STEP = 1
    RESET = 2
    CALL = 3
    """Of a method; its value is the reply, and no result."""
    JOIN = 4
    """Asked for by nobody: the first result of an env that comes by itself."""
    SNAPSHOT = 5
    """Its value is the env's state."""
    RESTORE = 6
    """Puts a state back, and shows nothing of it; a reset `AS_RESTORED` does."""


_WITH_VALUE: Final = (Operation.CALL, Operation.SNAPSHOT, Operation.RESTORE)
OP_BITS: Final = 8
SLOT_BITS: Final = 20
NUMBER_SHIFT: Final = OP_BITS + SLOT_BITS
SLOT_MASK: Final = (1 << SLOT_BITS) - 1
OP_MASK: Final = (1 << OP_BITS) - 1


def entry(number: int, slot: int, op: int) -> int:
    """One entry."""
    return (number << NUMBER_SHIFT) | (slot << OP_BITS) | op


def answers_with_value(op: int) -> bool:
    """Whether the reply to an operation is a value of its own, and no result in a row."""
    return op in _WITH_VALUE


def number_of(entry: int) -> int:
    """The number of the request that an entry is about."""
    return entry >> NUMBER_SHIFT


def slot_of(entry: int) -> int:
    """The slot of the env that an entry is about."""
    return (entry >> OP_BITS) & SLOT_MASK


def op_of(entry: int) -> int:
    """What an entry asks for, an `Operation`."""
    return entry & OP_MASK
