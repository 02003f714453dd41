"""Transitions of requests: every line of `LEGAL`, and why no other can happen.

`Requests` has no method for each event of its table; `Driven` maps events to calls. A state machine
then does all of it at random, over several hosts, and compares with a naive model.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rlightning_aio._core.group.state.checked import CheckedRequests
from rlightning_aio._core.group.state.request_states import (
    COLLECTOR,
    LEGAL,
    NOBODY,
    Event,
    Owner,
    State,
)
from rlightning_aio.errors import EnvFault
from rlightning_aio.protocol.entries import SLOT_MASK, Operation
from rlightning_aio.protocol.entries import entry as entry_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

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
            Event.JOINED: lambda: self.table.join(SLOT, 1.0),
            Event.RESULT: self._result,
            Event.VALUE: lambda: self.table.set_value(self._end(), "value"),
            Event.FAULT: self._fail,
            Event.WITHDRAWN: lambda: self.table.withdraw(self._end()),
            Event.RESTARTED: self._restart,
            Event.HANDED_OUT: lambda: self.table.hand_out(self.table.collector.take(1)),
            Event.SETTLED: self._settle,
            Event.GIVEN_UP: self._give_up,
            Event.METHOD_GIVEN_UP: self._give_up,
            Event.CLAIMED: self._claim,
            Event.DROPPED: lambda: self.table.claim(self.table.alone(SLOT), None),
            Event.KEPT: lambda: self.table.collector.keep(self.table.alone(SLOT), fault()),
            Event.FREED: self._free,
            Event.ABORTED: self._abort,
        }

    def situation(self) -> Situation:
        return State(self.table.state.item(SLOT)), kind_of(self.table.owner.item(SLOT))

    def entry(self, slot: int = SLOT) -> int:
        return self.table.numbering.entry.item(slot)

    def _ask(self, slots: list[int], op: int, owner: int) -> None:
        asked = np.array(slots)
        self.table.submit(asked, op, owner, 1.0)
        for _ in self.table.by_host(asked):
            pass

    def _call(self) -> None:
        slots = [SLOT, COMPANION]
        self.ticket = self.table.tickets.open(np.array(slots), method="render" * self.method)
        op = Operation.CALL if self.method else Operation.RESET
        self._ask(slots, op, self.ticket.owner)

    def _claim(self) -> None:
        self.ticket = self.table.tickets.open(np.array([SLOT, COMPANION]))
        self.table.claim(self.table.alone(SLOT), self.ticket)
        self._ask([COMPANION], Operation.RESET, self.ticket.owner)

    def _free(self) -> None:
        fault = self.table.collector.errors[SLOT]
        assert self.table.collector.take_fault(fault).tolist() == [SLOT]

    def _result(self) -> None:
        assert self.table.complete_one(1, self.entry()) == SLOT

    def _end(self) -> int:
        slot = self.table.end(1, self.entry())
        assert slot == SLOT
        return slot

    def _fail(self) -> None:
        slots = self.table.alone(self._end())
        ((owner, mine),) = self.table.owners(slots)
        self.table.fail(mine, owner, fault())

    def _abort(self) -> None:
        self.table.aborted.add(SLOT, fault())
        assert self.table.end(1, self.entry()) is None
        assert not self.table.aborted.faults

    def _restart(self) -> None:
        owed = self.table.owed(np.arange(3))
        self.table.lose_host(1)
        self.table.restart(1, owed)

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
UNCOLLECTED: Situation = (State.READY, Owner.COLLECTOR)
ALL: list[Combination] = list(itertools.product(State, Owner, Event))
NOT_EXPRESSIBLE: dict[Combination, str] = {
    (State.BUSY, Owner.COLLECTOR, Event.VALUE): "only methods have values; each has a ticket",
    (State.BUSY, Owner.TICKET, Event.WITHDRAWN): "a call learns by an error that its env is away",
    (State.BUSY, Owner.NOBODY, Event.RESULT): "what was given up for nobody is a method",
    (State.BUSY, Owner.NOBODY, Event.WITHDRAWN): "no method of a client's env can be called",
    (State.BUSY, Owner.NOBODY, Event.RESTARTED): "a method fails with its worker",
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
    if event in (Event.CLAIMED, Event.DROPPED) and (state, owner) == UNCOLLECTED:
        way = [Event.JOINED]
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
        Event.SENT, Event.SENT_FOR_CALL, Event.JOINED, Event.KEPT,
    )  # fmt: skip
    if event in needs_idle:
        assert table.first_not_idle(slots) == SLOT
        assert not table.is_idle(SLOT)
    elif event in (Event.RESULT, Event.VALUE, Event.FAULT, Event.WITHDRAWN):
        # A reply without a request, like a late one.
        assert table.end(1, driven.entry()) is None
        assert table.complete_one(1, driven.entry()) is None
    elif event in (Event.RESTARTED, Event.ABORTED):
        assert table.owed(slots).size == 0
    elif event in (Event.CLAIMED, Event.DROPPED):
        assert not table.joined(slots).any()
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
    driven.events[Event.FAULT]()
    assert not driven.table.collector.faults


def test_a_first_result_is_handed_out_once() -> None:
    """To any other call the env is busy, whatever it would do with a first result."""
    table = CheckedRequests(HOST_OF, 2)
    ticket = table.tickets.open(np.array([SLOT, COMPANION]))
    table.join(SLOT, 1.0)
    assert table.joined(table.alone(SLOT)).all()
    table.claim(table.alone(SLOT), ticket)
    assert not table.joined(table.alone(SLOT)).any()


# -- the debug mode


@pytest.mark.parametrize(
    ("state", "owner", "event"),
    [
        (State.IDLE, Owner.COLLECTOR, Event.HANDED_OUT),
        (State.BUSY, Owner.COLLECTOR, Event.SENT),
        (State.READY, Owner.COLLECTOR, Event.JOINED),
        (State.SPENT, Owner.TICKET, Event.RESULT),
        (State.BUSY, Owner.NOBODY, Event.RESTARTED),
    ],
    ids=named,
)
def test_the_debug_mode_refuses_an_illegal_event(state: State, owner: Owner, event: Event) -> None:
    """The error names the event, the slot and its state, and nothing has changed."""
    table = brought_to(state, owner).table
    slots = table.alone(SLOT)
    bring_about: dict[Event, Callable[[], object]] = {
        Event.HANDED_OUT: lambda: table.hand_out(slots),
        Event.SENT: lambda: table.submit(slots, Operation.STEP, COLLECTOR, 1.0),
        Event.JOINED: lambda: table.join(SLOT, 1.0),
        Event.RESULT: lambda: table.deliver(slots),
        Event.RESTARTED: lambda: table.restart(1, slots),
    }
    message = f"{event.name} can't happen to slot {SLOT}, which is {state.name} for {owner.name}"
    with pytest.raises(RuntimeError, match=message):
        bring_about[event]()
    assert (State(table.state.item(SLOT)), kind_of(table.owner.item(SLOT))) == (state, owner)


def test_the_debug_mode_refuses_a_change_without_an_event() -> None:
    """Whatever writes to the table must say what happened."""
    table = brought_to(State.BUSY, Owner.COLLECTOR).table
    table.state[SLOT] = State.IDLE
    with pytest.raises(RuntimeError, match=f"slot {SLOT} became IDLE for COLLECTOR without"):
        table.withdraw(SLOT)


@pytest.mark.parametrize(("value", "checked"), [("1", True), ("", False)])
def test_the_debug_mode_is_on_where_the_variable_says_so(value: str, checked: bool) -> None:
    """A group has the checked table, or the other."""
    variables = {**os.environ, "RLIGHTNING_AIO_DEBUG": value}
    program = (
        "from rlightning_aio.sync import build_env_group\n"
        "group = build_env_group({'name': 'pole', 'backend': 'gymnasium',"
        " 'task': 'CartPole-v1', 'placement': 'inline'})\n"
        "print(type(group._core.requests).__name__)\n"
        "group.close()\n"
    )
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, capture_output=True, check=True, text=True, env=variables)
    assert ended.stdout.split() == ["CheckedRequests" if checked else "Requests"]


# -- everything at once, compared with a model


@dataclass
class Asked:
    """The model's view of a slot.

    Attributes:
        came: counts the moments at which results came.
        error: that it ended in.
    """

    op: Operation | None = None
    state: State = State.IDLE
    owner: Claim | None = None
    nobodys: bool = False
    entry: int = 0
    came: int = 0
    error: EnvFault | None = None


@dataclass(eq=False)
class Claim:
    """The model's view of a call."""

    ticket: Ticket
    slots: list[int]
    faults: list[EnvFault] = field(default_factory=list[EnvFault])


class RequestsMachine(RuleBasedStateMachine):
    """Each rule acts on the table and on the model; the invariant compares them."""

    @initialize(counts=st.lists(st.integers(1, 3), min_size=1, max_size=4))
    def begin(self, counts: list[int]) -> None:
        self.host_of = np.repeat(np.arange(len(counts)), counts)
        self.table = CheckedRequests(self.host_of, len(counts))
        self.slots = [Asked() for _ in self.host_of]
        self.claims: list[Claim] = []
        self.late: list[int] = []
        self.faults: list[EnvFault] = []
        self.moment = 0

    # -- drawing

    def those(self, *states: State, host: int | None = None) -> list[int]:
        return [
            slot
            for slot, asked in enumerate(self.slots)
            if asked.state in states and host in (None, self.host_of[slot])
        ]

    def some(self, data: st.DataObject, slots: list[int]) -> list[int]:
        return data.draw(st.lists(st.sampled_from(slots), min_size=1, unique=True))

    def one_busy(self, data: st.DataObject) -> tuple[int, Asked]:
        slot = data.draw(st.sampled_from(self.those(State.BUSY)))
        return slot, self.slots[slot]

    # -- requests

    def ask(self, slots: list[int], op: Operation, claim: Claim | None) -> None:
        asked = np.array(slots, np.intp)
        owner = COLLECTOR if claim is None else claim.ticket.owner
        by_auto_reset = op is Operation.RESET and claim is None
        entries = self.table.submit(asked, Operation.STEP if by_auto_reset else op, owner, 1.0)
        if by_auto_reset:
            self.table.numbering.into_resets(asked, entries, np.ones(len(slots), np.bool_))
        parts = list(self.table.by_host(asked))
        given = [slot for _, part in parts for slot in asked[part].tolist()]
        assert given == slots
        assert all((self.host_of[asked[part]] == host).all() for host, part in parts)
        for slot, entry in zip(slots, entries.tolist(), strict=True):
            self.slots[slot] = Asked(op, State.BUSY, claim, entry=entry)

    @precondition(lambda self: self.those(State.IDLE))
    @rule(data=st.data(), reset=st.booleans())
    def ask_for_the_collector(self, data: st.DataObject, reset: bool) -> None:
        op = Operation.RESET if reset else Operation.STEP
        self.ask(self.some(data, self.those(State.IDLE)), op, None)

    @precondition(lambda self: self.those(State.IDLE))
    @rule(data=st.data(), op=st.sampled_from((Operation.STEP, Operation.RESET, Operation.CALL)))
    def ask_for_a_call(self, data: st.DataObject, op: Operation) -> None:
        """Send requests of a call. A reset also gets the first results of new clients."""
        slots = self.some(data, self.those(State.IDLE))
        joined = self.joined() if op is Operation.RESET else []
        taken = self.some(data, joined) if joined else []
        everyone = np.array(slots + taken, np.intp)
        method = "render" if op is Operation.CALL else ""
        claim = Claim(self.table.tickets.open(everyone, method=method), slots + taken)
        self.claims.append(claim)
        if taken:
            self.table.claim(np.array(taken), claim.ticket)
            for slot in taken:
                self.slots[slot].owner = claim
        self.ask(slots, op, claim)

    @rule(data=st.data(), method=st.sampled_from(("", "render")))
    def refuse(self, data: st.DataObject, method: str) -> None:
        """Make a call that is refused before it sends anything; the requests of others stay."""
        slots = self.some(data, list(range(len(self.slots))))
        self.table.give_up(self.table.tickets.open(np.array(slots), method=method))

    @precondition(lambda self: self.those(State.IDLE))
    @rule(data=st.data())
    def join(self, data: st.DataObject) -> None:
        slot = data.draw(st.sampled_from(self.those(State.IDLE)))
        self.table.join(slot, 1.0)
        self.moment += 1
        entry = self.table.numbering.entry.item(slot)
        self.slots[slot] = Asked(Operation.JOIN, State.READY, entry=entry, came=self.moment)

    def joined(self) -> list[int]:
        return [
            slot
            for slot in self.those(State.READY)
            if self.slots[slot].op is Operation.JOIN and self.slots[slot].owner is None
        ]

    @precondition(lambda self: self.joined())
    @rule(data=st.data())
    def drop_first_results(self, data: st.DataObject) -> None:
        slots = self.some(data, self.joined())
        self.table.claim(np.array(slots), None)
        for slot in slots:
            self.slots[slot] = Asked(entry=self.slots[slot].entry)

    # -- answers

    def deliver(self, slots: list[int]) -> None:
        self.moment += 1
        for slot in slots:
            self.slots[slot].state, self.slots[slot].came = State.READY, self.moment

    @precondition(lambda self: self.those(State.BUSY))
    @rule(data=st.data())
    def report(self, data: st.DataObject) -> None:
        """Results of one host, among them some that are late."""
        host = int(self.host_of[self.one_busy(data)[0]])
        busy = [
            slot
            for slot in self.those(State.BUSY, host=host)
            if self.slots[slot].op is not Operation.CALL
        ]
        slots = data.draw(st.lists(st.sampled_from(busy), unique=True)) if busy else []
        reported = [self.slots[slot].entry for slot in slots]
        # A worker that writes where it should not may report an env that doesn't exist.
        late = [*self.late, entry_of(1, SLOT_MASK, Operation.STEP)]
        reported += data.draw(st.lists(st.sampled_from(late), max_size=2))
        entries = np.array(data.draw(st.permutations(reported)), np.int64)
        found = self.table.complete([(host, entries)]).tolist()
        assert sorted(found) == sorted(slots)
        self.deliver(found)

    @precondition(lambda self: self.those(State.BUSY))
    @rule(data=st.data())
    def answer(self, data: st.DataObject) -> None:
        """End one request with the kind of reply it was sent for."""
        slot, asked = self.one_busy(data)
        host = int(self.host_of[slot])
        if asked.op is not Operation.CALL:
            assert self.table.complete_one(host, asked.entry) == slot
            self.deliver([slot])
            return
        assert self.table.end(host, asked.entry) == slot
        self.table.set_value(slot, slot)
        if asked.owner is not None:
            assert asked.owner.ticket.values[slot] == slot
        self.finish(slot)

    def finish(self, slot: int) -> None:
        """Record the end of a request without a result."""
        asked = self.slots[slot]
        if asked.owner is None:
            self.slots[slot] = Asked(entry=asked.entry)
        else:
            asked.state = State.SPENT

    def fail(self, slots: list[int]) -> None:
        """End requests that are no longer in flight in one error for each owner."""
        owners = self.table.owners(np.array(slots, np.intp))
        assert sorted(slot for _, mine in owners for slot in mine.tolist()) == sorted(slots)
        for owner, mine in owners:
            error = fault()
            self.table.fail(mine, owner, error)
            first = self.slots[mine.item(0)]
            if first.owner is not None:
                first.owner.faults.append(error)
            elif not first.nobodys:
                self.faults.append(error)
            for slot in mine.tolist():
                if self.slots[slot].nobodys:
                    self.finish(slot)
                else:
                    self.slots[slot].state, self.slots[slot].error = State.SPENT, error

    @precondition(lambda self: self.those(State.BUSY))
    @rule(data=st.data())
    def raise_error(self, data: st.DataObject) -> None:
        slot, asked = self.one_busy(data)
        assert self.table.end(int(self.host_of[slot]), asked.entry) == slot
        self.fail([slot])

    @precondition(lambda self: self.those(State.BUSY))
    @rule(data=st.data())
    def withdraw(self, data: st.DataObject) -> None:
        """Withdraw a request: a collect gets nothing for it, a call an error."""
        slot, asked = self.one_busy(data)
        assert self.table.end(int(self.host_of[slot]), asked.entry) == slot
        if asked.owner is None and not asked.nobodys:
            self.table.withdraw(slot)
            self.finish(slot)
        else:
            self.fail([slot])

    @precondition(lambda self: self.those(State.BUSY))
    @rule(data=st.data(), how=st.sampled_from(("reported", "ended", "lost")))
    def abort(self, data: st.DataObject, how: str) -> None:
        """Whatever a host says of requests that were aborted, they end without a reply."""
        host = int(self.host_of[self.one_busy(data)[0]])
        slots = self.some(data, self.those(State.BUSY, host=host))
        errors = {slot: fault() for slot in slots}
        for slot in slots:
            self.table.aborted.add(slot, errors[slot])
        entries = [self.slots[slot].entry for slot in slots]
        if how == "reported":
            assert not len(self.table.complete([(host, np.array(entries))]))
        elif how == "ended":
            assert [self.table.end(host, entry) for entry in entries] == [None] * len(slots)
        else:
            self.die_with(host, aborted=slots)
        assert not self.table.aborted.faults
        for slot in slots:
            claim = self.slots[slot].owner
            if claim is not None:
                claim.slots.remove(slot)
                claim.faults.append(errors[slot])
            self.slots[slot] = Asked(entry=self.slots[slot].entry)

    @precondition(lambda self: self.late)
    @rule(data=st.data())
    def answer_late(self, data: st.DataObject) -> None:
        """Send a late reply, which has no effect."""
        entry = data.draw(st.sampled_from(self.late))
        host = data.draw(st.sampled_from(range(len(self.table.in_flight))))
        assert self.table.end(host, entry) is None
        assert self.table.complete_one(host, entry) is None

    # -- deaths

    @rule(data=st.data(), replaced=st.booleans())
    def die(self, data: st.DataObject, replaced: bool) -> None:
        """Let a host die: steps and resets are sent again to a replacement; all else ends in
        errors.
        """
        self.die_with(data.draw(st.sampled_from(range(len(self.table.in_flight)))), replaced)

    def die_with(self, host: int, replaced: bool = True, aborted: Sequence[int] = ()) -> None:
        """Let a host die, for whose death there may be requests that were aborted."""
        owed = self.those(State.BUSY, host=host)
        self.table.lose_host(host)
        others = self.table.end_aborted(np.array(owed, np.intp)).tolist()
        assert others == [slot for slot in owed if slot not in aborted]
        owed = others
        again = [s for s in owed if replaced and self.slots[s].op is not Operation.CALL]
        if failed := [slot for slot in owed if slot not in again]:
            self.fail(failed)
        if not again:
            return
        asked = np.array(again)
        entries = self.table.restart(host, asked).tolist()
        for slot, entry in zip(again, entries, strict=True):
            self.late.append(self.slots[slot].entry)
            self.slots[slot].entry, self.slots[slot].op = entry, Operation.RESET

    # -- calls that end

    @precondition(lambda self: self.claims)
    @rule(data=st.data())
    def settle_or_give_up(self, data: st.DataObject) -> None:
        """Settle a call that has nothing left to wait for; cancel any other."""
        claim = data.draw(st.sampled_from(self.claims))
        self.claims.remove(claim)
        if any(self.slots[slot].state is State.BUSY for slot in claim.slots):
            self.give_up(claim)
            return
        self.table.settle(claim.ticket)
        ready = [slot for slot in claim.slots if self.slots[slot].state is State.READY]
        assert sorted(self.table.ready(claim.ticket.slots).tolist()) == sorted(ready)
        self.table.hand_out(np.array(ready, np.intp))
        for slot in claim.slots:
            self.slots[slot] = Asked(entry=self.slots[slot].entry)

    @precondition(lambda self: self.claims)
    @rule(data=st.data())
    def interrupt(self, data: st.DataObject) -> None:
        """Cancel a call, possibly at the moment when it has all replies."""
        claim = data.draw(st.sampled_from(self.claims))
        self.claims.remove(claim)
        self.give_up(claim)

    def give_up(self, claim: Claim) -> None:
        self.table.give_up(claim.ticket)
        self.moment += 1
        if not claim.ticket.calls:
            self.faults += claim.faults
        for slot in claim.slots:
            asked = self.slots[slot]
            asked.owner = None
            if asked.state is State.SPENT and not claim.ticket.calls:
                continue  # It is busy until the collector raises its error.
            if asked.state is State.SPENT:
                self.slots[slot] = Asked(entry=asked.entry)
            elif claim.ticket.calls:
                asked.nobodys = True
            elif asked.state is State.READY:
                asked.came = self.moment

    # -- the collector

    def collectable(self) -> list[int]:
        return [slot for slot in self.those(State.READY) if not self.slots[slot].owner]

    @precondition(collectable)
    @rule(most=st.integers(1, 6))
    def take(self, most: int) -> None:
        """Collect: first come, first served; results that came together are in any order."""
        here = self.collectable()
        taken = self.table.collector.take(most).tolist()
        assert len(taken) == len(set(taken)) == min(most, len(here))
        assert set(taken) <= set(here)
        assert taken == sorted(taken)
        came = sorted(self.slots[slot].came for slot in taken)
        assert came == sorted(self.slots[slot].came for slot in here)[:most]
        self.table.hand_out(np.array(taken, np.intp))
        for slot in taken:
            self.slots[slot] = Asked(entry=self.slots[slot].entry)

    def failed(self) -> list[int]:
        return [slot for slot in self.those(State.SPENT) if self.slots[slot].owner is None]

    @precondition(lambda self: self.faults)
    @rule(data=st.data())
    def raise_for_the_collector(self, data: st.DataObject) -> None:
        """Raise an error; all envs whose requests it answers are free."""
        error = self.faults.pop(data.draw(st.integers(0, len(self.faults) - 1)))
        slots = [slot for slot in self.failed() if self.slots[slot].error is error]
        assert sorted(self.table.collector.take_fault(error).tolist()) == slots
        for slot in slots:
            self.slots[slot] = Asked(entry=self.slots[slot].entry)

    @precondition(lambda self: self.failed())
    @rule(data=st.data())
    def free_failed(self, data: st.DataObject) -> None:
        """Free envs whose errors wait; the errors stay."""
        slots = self.some(data, list(range(len(self.slots))))
        free = [slot for slot in slots if slot in self.failed()]
        assert self.table.collector.free(slots).tolist() == free
        for slot in free:
            self.slots[slot] = Asked(entry=self.slots[slot].entry)

    # -- invariants

    @invariant()
    def the_table_is_the_model(self) -> None:
        table, slots = self.table, self.slots
        assert table.state.tolist() == [asked.state for asked in slots]
        owners = [NOBODY if a.nobodys else a.owner.ticket.owner if a.owner else 0 for a in slots]
        assert table.owner.tolist() == owners
        assert table.numbering.entry[[a.state is not State.IDLE for a in slots]].tolist() == [
            asked.entry for asked in slots if asked.state is not State.IDLE
        ]
        for slot, asked in enumerate(slots):
            assert table.is_idle(slot) == (asked.state is State.IDLE)
            assert asked.op in (None, table.numbering.op(slot))

    @invariant()
    def the_counts_are_the_models(self) -> None:
        table, slots = self.table, self.slots
        num_hosts = len(table.in_flight)
        busy = self.those(State.BUSY)
        assert table.in_flight == [len(self.those(State.BUSY, host=h)) for h in range(num_hosts)]
        assert set(table.collector.faults) == set(self.faults)
        assert len(table.collector.faults) == len(self.faults)
        mine = [s for s in busy if slots[s].owner is None and not slots[s].nobodys]
        ready = self.collectable()
        assert (table.collector.num_ready, table.collector.num_awaited) == (len(ready), len(mine))
        assert table.owed(np.arange(len(slots))).tolist() == busy
        not_idle = [slot for slot, asked in enumerate(slots) if asked.state is not State.IDLE]
        assert table.first_not_idle(np.arange(len(slots))) == (not_idle[0] if not_idle else None)

    @invariant()
    def tickets_know_what_is_outstanding(self) -> None:
        for claim in self.claims:
            busy = [slot for slot in claim.slots if self.slots[slot].state is State.BUSY]
            assert claim.ticket.remaining == len(busy)
            assert set(claim.ticket.faults) == set(claim.faults)


TestRequests = RequestsMachine.TestCase
TestRequests.settings = settings(stateful_step_count=30)
