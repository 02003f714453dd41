"""The states and owners of a request, what can happen to it, and the table of legal transitions."""

from __future__ import annotations

from enum import Enum, IntEnum, auto
from typing import Final


class State(IntEnum):
    """State of a slot's request."""

    IDLE = 0
    """Nothing is outstanding: the env can get a request."""
    BUSY = 1
    """Sent, and not answered."""
    READY = 2
    """The row holds a result that has not been returned."""
    SPENT = 3
    """Ended without a result, which its owner has not been told yet: in an error that waits for the
    collector, or in a call that still waits for other envs."""


class Owner(Enum):
    """Who gets the reply of a request."""

    COLLECTOR = auto()
    TICKET = auto()
    NOBODY = auto()


class Event(Enum):
    """What can happen to a request."""

    SENT = auto()
    SENT_FOR_CALL = auto()
    DROPPED = auto()
    """Nobody wants what it has led to; or it was held for a client, and never sent."""
    RESULT = auto()
    VALUE = auto()
    FAULT = auto()
    ABORTED = auto()
    """Its caller wants no reply."""
    ASKED_AGAIN = auto()
    FREED = auto()
    """The error that it ended in is raised, or its caller doesn't wait for that."""
    HANDED_OUT = auto()
    CLOSED = auto()
    """Its call has all replies that it waited for."""
    LEFT = auto()
    """Its call no longer waits."""
    METHOD_LEFT = auto()
    """The same for a method call, whose value no other call can use."""


_IDLE, _BUSY, _READY, _SPENT = State
_C, _T, _N = Owner

LEGAL: Final[dict[tuple[State, Owner, Event], tuple[State, Owner]]] = {
    # An idle slot has no owner, which the table writes as the collector.
    (_IDLE, _C, Event.SENT): (_BUSY, _C),
    (_IDLE, _C, Event.SENT_FOR_CALL): (_BUSY, _T),
    (_BUSY, _C, Event.RESULT): (_READY, _C),
    (_BUSY, _C, Event.FAULT): (_SPENT, _C),
    (_BUSY, _C, Event.DROPPED): (_IDLE, _C),
    (_BUSY, _T, Event.DROPPED): (_IDLE, _C),
    (_BUSY, _C, Event.ABORTED): (_BUSY, _N),
    (_BUSY, _C, Event.ASKED_AGAIN): (_BUSY, _C),
    (_READY, _C, Event.HANDED_OUT): (_IDLE, _C),
    (_READY, _C, Event.DROPPED): (_IDLE, _C),
    (_SPENT, _C, Event.FREED): (_IDLE, _C),
    (_BUSY, _T, Event.RESULT): (_READY, _T),
    (_BUSY, _T, Event.VALUE): (_SPENT, _T),
    (_BUSY, _T, Event.FAULT): (_SPENT, _T),
    (_BUSY, _T, Event.ABORTED): (_BUSY, _N),
    (_BUSY, _T, Event.ASKED_AGAIN): (_BUSY, _T),
    (_BUSY, _T, Event.LEFT): (_BUSY, _C),
    (_BUSY, _T, Event.METHOD_LEFT): (_BUSY, _N),
    (_READY, _T, Event.LEFT): (_READY, _C),
    (_SPENT, _T, Event.LEFT): (_SPENT, _C),
    (_SPENT, _T, Event.METHOD_LEFT): (_IDLE, _C),
    (_READY, _T, Event.CLOSED): (_READY, _C),
    (_SPENT, _T, Event.CLOSED): (_IDLE, _C),
    (_BUSY, _N, Event.DROPPED): (_IDLE, _C),
}
"""State and owner after each possible event. A combination that is missing can't happen."""

COLLECTOR: Final = 0
NOBODY: Final = -1
"""Owners in the table; tickets have numbers above 0."""
