"""Transitions of requests: every line of `LEGAL`, and why no other can happen.

`Requests` has no method for each event of its table; `Driven` maps events to calls. What many
events of several hosts lead to, random programs show (`tests/simulator`).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pytest
from kit.checked import CheckedRequests

from rlightning_aio._core.group.state.request_states import (
    COLLECTOR,
    LEGAL,
    NOBODY,
    Event,
    Owner,
    State,
)
from rlightning_aio.errors import EnvFault
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.group.state.requests import Ticket

Situation: TypeAlias = tuple[State, Owner]
Combination: TypeAlias = tuple[State, Owner, Event]

HOST_OF = np.array([0, 1, 1])
SLOT, COMPANION = 1, 2
"""The slot under test, and another slot of its host that its calls wait for, too."""


def fault() -> EnvFault:
    return EnvFault("as asked for", env_id="any")


def kind_of(owner: int) -> Owner:
    return {COLLECTOR: Owner.COLLECTOR, NOBODY: Owner.NOBODY}.get(owner, Owner.TICKET)


class Driven:
    """A table, and a method for each event that can happen to `SLOT`.

    Args:
        method: calls are of methods, instead of steps and resets.
    """

    def __init__(self, *, method: bool = False) -> None:
        self.table = CheckedRequests(HOST_OF, 2)
        self.method = method
        self.ticket: Ticket | None = None
        self.settled: list[int] = []
        self.events: dict[Event, Callable[[], None]] = {
            Event.SENT: lambda: self._ask([SLOT], Operation.STEP, COLLECTOR),
            Event.SENT_FOR_CALL: self._call,
            Event.RESULT: self._result,
            Event.VALUE: lambda: self.table.set_value(self._end(), "value"),
            Event.FAULT: self._fail,
            Event.TAKEN_BACK: self._take_back,
            Event.ASKED_AGAIN: self._restart,
            Event.HANDED_OUT: lambda: self.table.hand_out(self.table.collector.pop_ready(1)),
            Event.SETTLED: self._settle,
            Event.GIVEN_UP: self._give_up,
            Event.METHOD_GIVEN_UP: self._give_up,
            Event.DROPPED: self._drop,
            Event.FREED: self._free,
            Event.ABORTED: self._abort,
        }

    def situation(self) -> Situation:
        return State(self.table.state.item(SLOT)), kind_of(self.table.owner.item(SLOT))

    def entry(self, slot: int = SLOT) -> int:
        return self.table.numbering.entry.item(slot)

    def _ask(self, slots: list[int], op: int, owner: int) -> None:
        asked = np.array(slots)
        self.table.issue(asked, op, owner, 1.0)
        for _ in self.table.put_in_flight(asked):
            pass

    def _call(self) -> None:
        slots = [SLOT, COMPANION]
        self.ticket = self.table.tickets.open(np.array(slots))
        op = Operation.CALL if self.method else Operation.RESET
        self._ask(slots, op, self.ticket.owner)

    def _take_back(self) -> None:
        slot = self._end()  # What is held is not in flight.
        if self.ticket is not None:
            self.table.tickets.forget(self.ticket.owner, self.table.alone(slot))
        self.table.take_back(self.table.alone(slot))

    def _free(self) -> None:
        fault = self.table.collector.errors[SLOT]
        assert self.table.collector.take_fault(fault).tolist() == [SLOT]

    def _result(self) -> None:
        assert self.table.complete([(1, np.array([self.entry()]))]).tolist() == [SLOT]

    def _end(self) -> int:
        slot = self.table.end(1, self.entry())
        assert slot == SLOT
        return slot

    def _fail(self) -> None:
        slots = self.table.alone(self._end())
        ((owner, mine),) = self.table.owners(slots)
        self.table.fail(mine, owner, fault())

    def _abort(self) -> None:
        lost = fault()
        self.table.abort(self.table.alone(SLOT), [lost])
        if self.ticket is not None:
            assert self.ticket.errors == {SLOT: lost}
            assert SLOT not in self.ticket.slots

    def _drop(self) -> None:
        if SLOT in self.table.unwanted:
            assert self.table.end(1, self.entry()) is None
            assert SLOT not in self.table.unwanted
        else:
            self.table.drop(self.table.alone(SLOT))

    def _restart(self) -> None:
        owed = self.table.owed(np.arange(3))
        self.table.in_flight[1] = 0
        self.table.ask_again(1, owed)

    def _settle(self) -> None:
        assert self.ticket is not None
        slot = self.table.end(1, self.entry(COMPANION))
        assert slot == COMPANION
        if self.method:
            self.table.set_value(slot, None)
        else:
            self.table.fail(self.table.alone(slot), self.ticket.owner, fault())
        assert self.ticket.remaining == 0
        self.table.settle(self.ticket)
        # A call hands out its results at once; no collect can get them.
        self.settled = self.table.ready(self.ticket.slots).tolist()

    def _give_up(self) -> None:
        assert self.ticket is not None
        self.table.give_up(self.ticket)

    def check_counts(self) -> None:
        """Compare every count with the arrays."""
        table = self.table
        busy, ready = table.state == State.BUSY, table.state == State.READY
        collected = table.owner == COLLECTOR
        collected[self.settled] = False
        assert table.in_flight == [int(busy[host == HOST_OF].sum()) for host in range(2)]
        assert sum(table.in_flight) == busy.sum()
        assert table.collector.num_ready == (ready & collected).sum()
        assert table.collector.num_awaited == (busy & collected).sum()
        failed = (table.state == State.SPENT) & collected
        assert sorted(table.collector.errors) == np.flatnonzero(failed).tolist()
        table.hand_out(np.array(self.settled, np.intp))


# The events that lead to each situation; of method calls where it matters.
STEPS: dict[Situation, list[Event]] = {
    (State.IDLE, Owner.COLLECTOR): [],
    (State.BUSY, Owner.COLLECTOR): [Event.SENT],
    (State.READY, Owner.COLLECTOR): [Event.SENT, Event.RESULT],
    (State.SPENT, Owner.COLLECTOR): [Event.SENT, Event.FAULT],
    (State.BUSY, Owner.TICKET): [Event.SENT_FOR_CALL],
    (State.READY, Owner.TICKET): [Event.SENT_FOR_CALL, Event.RESULT],
    (State.SPENT, Owner.TICKET): [Event.SENT_FOR_CALL, Event.FAULT],
}
METHODS: dict[Situation, list[Event]] = {
    (State.BUSY, Owner.TICKET): [Event.SENT_FOR_CALL],
    (State.SPENT, Owner.TICKET): [Event.SENT_FOR_CALL, Event.VALUE],
    (State.BUSY, Owner.NOBODY): [Event.SENT_FOR_CALL, Event.METHOD_GIVEN_UP],
}
ALL: list[Combination] = list(itertools.product(State, Owner, Event))
NOT_EXPRESSIBLE: dict[Combination, str] = {
    (State.BUSY, Owner.COLLECTOR, Event.VALUE): "only methods have values; each has a ticket",
    (State.BUSY, Owner.NOBODY, Event.RESULT): "whatever ends it, its reply is dropped",
    (State.BUSY, Owner.NOBODY, Event.VALUE): "likewise",
    (State.BUSY, Owner.NOBODY, Event.FAULT): "likewise",
    (State.BUSY, Owner.NOBODY, Event.TAKEN_BACK): "likewise",
    (State.BUSY, Owner.NOBODY, Event.ABORTED): "it is aborted once",
    (State.BUSY, Owner.NOBODY, Event.ASKED_AGAIN): "what nobody waits for ends with its worker",
    (State.READY, Owner.TICKET, Event.METHOD_GIVEN_UP): "methods have values, not results",
}
REACHABLE = {*STEPS, *METHODS}
REFUSED = [
    combination
    for combination in ALL
    if combination[:2] in REACHABLE and combination not in {*LEGAL, *NOT_EXPRESSIBLE}
]


def brought_to(state: State, owner: Owner, event: Event | None = None) -> Driven:
    """Return a table whose slot is in the situation, right before `event`."""
    of_methods = event in (Event.VALUE, Event.METHOD_GIVEN_UP) and (state, owner) in METHODS
    method = owner is Owner.NOBODY or of_methods
    driven = Driven(method=method)
    way = (METHODS if method else STEPS)[state, owner]
    for past in way:
        driven.events[past]()
    assert driven.situation() == (state, owner)
    driven.check_counts()
    return driven


def named(value: object) -> str:
    return value.name if isinstance(value, State | Owner | Event) else str(value)


@pytest.mark.parametrize(("state", "owner", "event"), LEGAL, ids=named)
def test_a_legal_event_does_what_the_table_says(state: State, owner: Owner, event: Event) -> None:
    """State, owner and counts follow the table."""
    driven = brought_to(state, owner, event)
    driven.events[event]()
    assert driven.situation() == LEGAL[state, owner, event]
    driven.check_counts()


@pytest.mark.parametrize(("state", "owner", "event"), REFUSED, ids=named)
def test_any_other_event_is_refused_or_has_no_effect(
    state: State, owner: Owner, event: Event
) -> None:
    """The call that could cause it raises, or finds no request."""
    driven = brought_to(state, owner, event)
    table = driven.table
    slots = table.alone(SLOT)
    needs_idle = (
        Event.SENT, Event.SENT_FOR_CALL,
    )  # fmt: skip
    if event in needs_idle:
        assert table.first_not_idle(slots) == SLOT
        assert not table.is_idle(SLOT)
    elif event in (Event.RESULT, Event.VALUE, Event.FAULT, Event.TAKEN_BACK):
        # A reply without a request, like a late one.
        assert table.end(1, driven.entry()) is None
    elif event in (Event.ASKED_AGAIN, Event.ABORTED):
        assert table.owed(slots).size == 0
    elif event is Event.DROPPED:
        assert not (table.ready(slots).size and table.owner[SLOT] == COLLECTOR)
    elif event is Event.FREED:
        assert SLOT not in table.collector.errors
    elif event is Event.HANDED_OUT:
        assert table.collector.num_ready == 0
    elif event is Event.SETTLED and owner is Owner.TICKET:
        assert driven.ticket is not None
        assert driven.ticket.remaining > 0
    else:
        assert not any(SLOT in ticket.slots for ticket in table.tickets.waiting.values())
    assert driven.situation() == (state, owner)
    driven.check_counts()


def test_every_combination_is_accounted_for() -> None:
    """Legal, refused, not expressible, or of an unreachable situation."""
    unreachable = {(state, owner) for state, owner, _ in ALL} - REACHABLE
    assert not unreachable & set(LEGAL.values())
    assert not NOT_EXPRESSIBLE.keys() & LEGAL.keys()
    rest = {combination for combination in ALL if combination[:2] in unreachable}
    assert {*LEGAL, *REFUSED, *NOT_EXPRESSIBLE, *rest} == set(ALL)


def test_every_situation_of_the_table_is_reachable() -> None:
    """By legal events, from an idle slot."""
    found: set[Situation] = set()
    new: set[Situation] = {(State.IDLE, Owner.COLLECTOR)}
    while new:
        found |= new
        new = {after for (*before, _), after in LEGAL.items() if tuple(before) in found} - found
    assert found == REACHABLE


def test_the_value_of_a_cancelled_method_call_has_no_owner() -> None:
    """Unlike a step or a reset: a collect can't return it."""
    driven = brought_to(State.BUSY, Owner.NOBODY)
    assert driven.table.collector.num_ready == driven.table.collector.num_awaited == 0
    driven.events[Event.DROPPED]()
    assert not driven.table.collector.faults


@pytest.mark.parametrize("owner", [Owner.COLLECTOR, Owner.TICKET])
def test_the_reply_to_an_aborted_request_is_dropped(owner: Owner) -> None:
    """Among others that came with it, too."""
    driven = brought_to(State.BUSY, owner)
    table = driven.table
    driven.events[Event.ABORTED]()
    others = np.array([slot for slot in range(3) if table.is_idle(slot)])
    table.issue(others, Operation.STEP, COLLECTOR, 1.0)
    for _ in table.put_in_flight(others):
        pass
    entries = table.numbering.entry
    for host_id in (0, 1):
        mine = np.flatnonzero(table.hosts == host_id)
        found = table.complete([(host_id, entries[mine])])
        assert SLOT not in found
    assert table.is_idle(SLOT)
    assert table.in_flight == [0, 0]


# -- every transition is checked


def test_a_late_reply_has_no_effect() -> None:
    """That of a request which another has taken the place of, after a death."""
    table = CheckedRequests(HOST_OF, 2)
    slots = np.array([SLOT])
    (late,) = table.issue(slots, Operation.STEP, COLLECTOR, 1.0).tolist()
    table.in_flight[1] = 0
    (entry,) = table.ask_again(1, slots).tolist()
    assert table.end(1, late) is None
    assert not len(table.complete([(1, np.array([late]))]))
    assert table.state[SLOT] == State.BUSY
    assert table.complete([(1, np.array([entry]))]).tolist() == [SLOT]


def test_results_that_came_first_are_taken_first() -> None:
    """Those that came together are in any order."""
    table = CheckedRequests(HOST_OF, 2)
    first, *others = table.issue(np.arange(3), Operation.STEP, COLLECTOR, 1.0).tolist()
    assert table.complete([(1, np.array(others))]).tolist() == [1, 2]
    assert table.complete([(0, np.array([first]))]).tolist() == [0]
    taken = [table.collector.pop_ready(1).item() for _ in range(3)]
    assert sorted(taken[:2]) == [1, 2]
    assert taken[2] == 0


@pytest.mark.parametrize(
    ("state", "owner", "event"),
    [
        (State.IDLE, Owner.COLLECTOR, Event.HANDED_OUT),
        (State.BUSY, Owner.COLLECTOR, Event.SENT),
        (State.READY, Owner.COLLECTOR, Event.RESULT),
        (State.SPENT, Owner.TICKET, Event.RESULT),
        (State.BUSY, Owner.NOBODY, Event.ASKED_AGAIN),
    ],
    ids=named,
)
def test_the_checked_table_refuses_an_illegal_event(
    state: State, owner: Owner, event: Event
) -> None:
    """The error names the event, the slot and its state, and nothing has changed."""
    table = brought_to(state, owner).table
    slots = table.alone(SLOT)
    bring_about: dict[Event, Callable[[], object]] = {
        Event.HANDED_OUT: lambda: table.hand_out(slots),
        Event.SENT: lambda: table.issue(slots, Operation.STEP, COLLECTOR, 1.0),
        Event.RESULT: lambda: table.deliver(slots),
        Event.ASKED_AGAIN: lambda: table.ask_again(1, slots),
    }
    message = f"{event.name} can't happen to slot {SLOT}, which is {state.name} for {owner.name}"
    with pytest.raises(RuntimeError, match=message):
        bring_about[event]()
    assert (State(table.state.item(SLOT)), kind_of(table.owner.item(SLOT))) == (state, owner)


def test_the_checked_table_refuses_a_change_without_an_event() -> None:
    """Whatever writes to the table must say what happened."""
    table = brought_to(State.BUSY, Owner.COLLECTOR).table
    table.state[SLOT] = State.IDLE
    with pytest.raises(RuntimeError, match=f"slot {SLOT} became IDLE for COLLECTOR without"):
        table.take_back(table.alone(SLOT))
