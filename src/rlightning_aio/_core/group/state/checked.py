"""The debug mode: each change of a request's state is checked against the table `LEGAL`.

`CheckedRequests` replaces `Requests` if the environment variable `RLIGHTNING_AIO_DEBUG` is 1 when
this module is imported. It applies each event to a copy of the table by `LEGAL`, and compares the
two. So it refuses an event that can't happen, a change that the event doesn't make, and a change
without an event. Without the variable, nothing here is called.
"""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.group.state.conditions import Conditions
from rlightning_aio._core.group.state.request_states import COLLECTOR, LEGAL, Event, Owner, State
from rlightning_aio._core.group.state.requests import CollectorQueue, Requests
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio.errors import EnvFault
    from rlightning_aio.protocol.exchange import Ring

__all__ = ["DEBUG", "CheckedRequests"]

DEBUG: Final = os.environ.get("RLIGHTNING_AIO_DEBUG") == "1"
"""Groups check their requests."""

_OWNERS: Final = list(Owner)
_TICKET: Final = _OWNERS.index(Owner.TICKET)
_NOBODY: Final = _OWNERS.index(Owner.NOBODY)
_IDLE: Final = int(State.IDLE)
_ILLEGAL: Final = -1


def _code(state: State, owner: Owner) -> int:
    """Number a situation: a state, and the kind of its owner."""
    return state * len(_OWNERS) + _OWNERS.index(owner)


def _codes_after(event: Event) -> NDArray[np.int64]:
    """Return the situation after `event`, by the situation before it."""
    after = np.full(len(State) * len(Owner), _ILLEGAL)
    for (state, owner, possible), situation in LEGAL.items():
        if possible is event:
            after[_code(state, owner)] = _code(*situation)
    return after


_AFTER: Final = {event: _codes_after(event) for event in Event}


class _CheckedQueue(CollectorQueue):
    """The collector's queue in a checked table."""

    def __init__(self, requests: CheckedRequests, conditions: Conditions) -> None:
        super().__init__(conditions, requests.state)
        self._changes = requests.changes

    def keep(self, slots: NDArray[np.intp], fault: EnvFault) -> None:
        with self._changes((Event.KEPT, slots)):
            super().keep(slots, fault)

    def free(self, slots: Sequence[int]) -> NDArray[np.intp]:
        with self._changes((Event.FREED, self.with_errors(slots))):
            return super().free(slots)


class CheckedRequests(Requests):
    """`Requests` that raises `RuntimeError` at a change that `LEGAL` doesn't allow."""

    def __init__(
        self, host_of: NDArray[np.int64], num_hosts: int, conditions: Conditions | None = None
    ) -> None:
        conditions = conditions or Conditions()
        super().__init__(host_of, num_hosts, conditions)
        self.collector = _CheckedQueue(self, conditions)
        self._known = self._situations()
        self._is_changing = False

    def _situations(self) -> NDArray[np.int64]:
        """Return the situation of each slot; an idle slot has no owner."""
        kinds = np.where(self.owner > 0, _TICKET, 0)
        kinds[self.owner < 0] = _NOBODY
        kinds[self.state == _IDLE] = 0
        return self.state.astype(np.int64) * len(_OWNERS) + kinds

    @contextlib.contextmanager
    def changes(self, *events: tuple[Event, NDArray[np.intp]]) -> Generator[None]:
        """Check that the context does to slots what these events mean, and nothing else."""
        if self._is_changing:  # The event is a part of another.
            yield
            return
        self._compare(self._known, "without an event")
        expected = self._known.copy()
        for event, slots in events:
            before = self._known[slots]
            after = _AFTER[event][before]
            illegal = np.flatnonzero(after == _ILLEGAL)
            if len(illegal):
                k = illegal.item(0)
                raise RuntimeError(
                    f"{event.name} can't happen to slot {slots[k]}, which is "
                    f"{_named(before.item(k))}"
                )
            expected[slots] = after
        try:
            self._is_changing = True
            yield
            self._compare(expected, f"by {', '.join(event.name for event, _ in events)}")
            self._known = expected
        except BaseException:
            self._known = self._situations()
            raise
        finally:
            self._is_changing = False

    def _compare(self, expected: NDArray[np.int64], how: str) -> None:
        found = self._situations()
        wrong = np.flatnonzero(found != expected)
        if len(wrong):
            slot = wrong.item(0)
            raise RuntimeError(
                f"slot {slot} became {_named(found.item(slot))} {how}; it would be "
                f"{_named(expected.item(slot))}"
            )

    def issue(self, slots: NDArray[np.intp], op: int, owner: int, now: float) -> NDArray[np.int64]:
        event = Event.SENT if owner == COLLECTOR else Event.SENT_FOR_CALL
        with self.changes((event, slots)):
            return super().issue(slots, op, owner, now)

    def publish(
        self, slots: NDArray[np.intp], resets: NDArray[np.bool_], owner: int, now: float
    ) -> list[Ring]:
        event = Event.SENT if owner == COLLECTOR else Event.SENT_FOR_CALL
        with self.changes((event, slots)):
            return super().publish(slots, resets, owner, now)

    def ask_again(self, host_id: int, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        with self.changes((Event.ASKED_AGAIN, slots)):
            return super().ask_again(host_id, slots)

    def join(self, slot: int, now: float, op: int = Operation.JOIN) -> None:
        with self.changes((Event.JOINED, self.alone(slot))):
            super().join(slot, now, op)

    def deliver(self, slots: NDArray[np.intp]) -> None:
        with self.changes((Event.RESULT, slots)):
            super().deliver(slots)

    def set_value(self, slot: int, value: Any) -> None:
        with self.changes((Event.VALUE, self.alone(slot))):
            super().set_value(slot, value)

    def fail(self, slots: NDArray[np.intp], owner: int, fault: EnvFault) -> None:
        with self.changes((Event.FAULT, slots)):
            super().fail(slots, owner, fault)

    def withdraw(self, slot: int) -> None:
        with self.changes((Event.WITHDRAWN, self.alone(slot))):
            super().withdraw(slot)

    def hand_out(self, slots: NDArray[np.intp]) -> None:
        with self.changes((Event.HANDED_OUT, slots)):
            super().hand_out(slots)

    def end_aborted(self, slots: NDArray[np.intp]) -> NDArray[np.intp]:
        with self.changes((Event.ABORTED, slots[self.aborted.among(slots)])):
            return super().end_aborted(slots)

    def claim(self, slots: NDArray[np.intp], ticket: Ticket | None) -> None:
        with self.changes((Event.DROPPED if ticket is None else Event.CLAIMED, slots)):
            super().claim(slots, ticket)

    def settle(self, ticket: Ticket) -> None:
        with self.changes((Event.SETTLED, ticket.slots)):
            super().settle(ticket)

    def settle_ended(self, ticket: Ticket) -> NDArray[np.intp]:
        ended = np.concatenate((*ticket.ended, ticket.slots[:0]))
        with self.changes((Event.SETTLED, ended)):
            return super().settle_ended(ticket)

    def give_up(self, ticket: Ticket) -> None:
        slots = ticket.submitted(self.owner)
        slots = slots[self.state[slots] != State.IDLE]  # An interrupt came before it was sent.
        values = slots if ticket.calls else slots[:0]
        others = np.setdiff1d(slots, values)
        with self.changes((Event.METHOD_GIVEN_UP, values), (Event.GIVEN_UP, others)):
            super().give_up(ticket)


def _named(code: int) -> str:
    state, owner = divmod(code, len(_OWNERS))
    return f"{State(state).name} for {_OWNERS[owner].name}"
