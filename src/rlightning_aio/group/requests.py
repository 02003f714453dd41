"""`Requests`: what was asked of each env, for whom, and how far it has come.

A pure table over slots, the positions of envs in their group: it knows hosts by their
numbers only, no time and no I/O. One request of an env is outstanding at a time; each of
them ends once, in a result, a value, an error or a withdrawal, and goes to the call that
waits for it or else to `collect`. What may happen to a request, and what it is then, is
said in `LEGAL`, from which the tests are made.

Facts are arrays, so that a batch of thousands costs a few vector operations.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum, IntEnum, auto
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol.entries import (
    NUMBER_SHIFT,
    OP_BITS,
    OP_MASK,
    SLOT_MASK,
    Operation,
    slot_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.errors import EnvFault

__all__ = ["COLLECTOR", "LEGAL", "NOBODY", "Event", "Owner", "Requests", "State", "Ticket"]


class State(IntEnum):
    """How far the request of a slot has come."""

    IDLE = 0
    """Nothing is outstanding: the env can be asked."""
    BUSY = 1
    """Asked, and not answered."""
    READY = 2
    """A result lies in the row, and has not been handed out."""
    SPENT = 3
    """Ended without a result, in a call that still waits for other envs."""


class Owner(Enum):
    """Who gets what becomes of a request."""

    COLLECTOR = auto()
    TICKET = auto()
    NOBODY = auto()


class Event(Enum):
    """What can happen to a request."""

    SENT = auto()
    SENT_FOR_CALL = auto()
    JOINED = auto()
    CLAIMED = auto()
    """A call takes a first result that waited for the collector."""
    DROPPED = auto()
    """A call asks for more than that first result."""
    RESULT = auto()
    VALUE = auto()
    FAULT = auto()
    WITHDRAWN = auto()
    RESTARTED = auto()
    HANDED_OUT = auto()
    SETTLED = auto()
    """Its call has all that it waited for."""
    GIVEN_UP = auto()
    """Its call waits no more."""
    METHOD_GIVEN_UP = auto()
    """The same for a method, whose value nobody else can use."""


_IDLE, _BUSY, _READY, _SPENT = State
_C, _T, _N = Owner

LEGAL: Final[dict[tuple[State, Owner, Event], tuple[State, Owner]]] = {
    # An idle slot belongs to nobody in particular, which is written as to the collector.
    (_IDLE, _C, Event.SENT): (_BUSY, _C),
    (_IDLE, _C, Event.SENT_FOR_CALL): (_BUSY, _T),
    (_IDLE, _C, Event.JOINED): (_READY, _C),
    (_BUSY, _C, Event.RESULT): (_READY, _C),
    (_BUSY, _C, Event.FAULT): (_IDLE, _C),
    (_BUSY, _C, Event.WITHDRAWN): (_IDLE, _C),
    (_BUSY, _C, Event.RESTARTED): (_BUSY, _C),
    (_READY, _C, Event.HANDED_OUT): (_IDLE, _C),
    (_READY, _C, Event.CLAIMED): (_READY, _T),
    (_READY, _C, Event.DROPPED): (_IDLE, _C),
    (_BUSY, _T, Event.RESULT): (_READY, _T),
    (_BUSY, _T, Event.VALUE): (_SPENT, _T),
    (_BUSY, _T, Event.FAULT): (_SPENT, _T),
    (_BUSY, _T, Event.RESTARTED): (_BUSY, _T),
    (_BUSY, _T, Event.GIVEN_UP): (_BUSY, _C),
    (_BUSY, _T, Event.METHOD_GIVEN_UP): (_BUSY, _N),
    (_READY, _T, Event.GIVEN_UP): (_READY, _C),
    (_SPENT, _T, Event.GIVEN_UP): (_IDLE, _C),
    (_READY, _T, Event.SETTLED): (_READY, _C),
    (_SPENT, _T, Event.SETTLED): (_IDLE, _C),
    (_BUSY, _N, Event.VALUE): (_IDLE, _C),
    (_BUSY, _N, Event.FAULT): (_IDLE, _C),
}
"""State and owner after each event that can come; what is missing can't."""

COLLECTOR: Final = 0
NOBODY: Final = -1
"""Owners as the table holds them; a ticket's own number is above 0."""

# Plain ints: NumPy takes several times as long over members of an enum.
_IDLE_CODE, _BUSY_CODE, _READY_CODE, _SPENT_CODE = map(int, State)
_STEP, _RESET, _JOIN = map(int, (Operation.STEP, Operation.RESET, Operation.JOIN))

# 0-d arrays: NumPy takes twice as long over a Python int.
_WITHOUT_OP: Final = np.array(~OP_MASK)
_OP: Final = np.array(OP_MASK)
_OP_BITS: Final = np.array(OP_BITS)
_SLOT_MASK: Final = np.array(SLOT_MASK)
_NEXT: Final = {op: np.array((1 << NUMBER_SHIFT) + op) for op in map(int, Operation)}
"""To be added to an entry without an operation."""


@dataclass(slots=True)
class Ticket:
    """A call that waits for requests of its own, beside `collect`.

    Attributes:
        remaining: of them that have not ended.
        method: whose calls they are; empty where they are none.
        values: what calls have returned, by slot.
    """

    owner: int
    slots: NDArray[np.intp]
    remaining: int
    method: str
    faults: list[EnvFault] = field(default_factory=list["EnvFault"])
    values: dict[int, Any] = field(default_factory=dict[int, Any])

    @property
    def calls(self) -> bool:
        """Whether the requests are calls of a method."""
        return bool(self.method)


class Requests:
    """See the module.

    Args:
        size: of the table; host_of: the host of each slot, in runs.
        num_hosts: numbered from 0.

    Attributes:
        entry: of each slot's current request, or its last: number, slot and operation.
        state: `State`; owner: of the current request.
        sent_ns: when it was sent.
        in_flight: requests of each host that are not answered; the only count of them.
        num_ready: results for the collector; num_awaited: requests whose results it will get.
        faults: errors for the collector, oldest first.
        answered: something has ended since this was set to False.
    """

    def __init__(self, host_of: NDArray[np.int64], num_hosts: int) -> None:
        size = len(host_of)
        self._each = np.arange(size)
        self._host_of = host_of
        self.entry = np.arange(size) << OP_BITS
        self.state = np.zeros(size, np.int8)
        self.owner = np.zeros(size, np.int64)
        self.sent_ns = np.zeros(size, np.int64)
        self.in_flight = [0] * num_hosts
        self.num_ready = 0
        self.num_awaited = 0
        self.faults: deque[EnvFault] = deque()
        self.answered = False
        self._ready: deque[NDArray[np.intp]] = deque()
        self._tickets: dict[int, Ticket] = {}
        self._next_ticket = 1

    # -- what is known ------------------------------------------------------------

    def number(self, slot: int) -> int:
        """Number of the current request; 0 before the first."""
        return int(self.entry[slot]) >> NUMBER_SHIFT

    def numbers(self, slots: Any = ...) -> NDArray[np.int64]:
        """Numbers of the current requests."""
        return self.entry[slots] >> NUMBER_SHIFT

    def op(self, slot: int) -> int:
        """Operation of the current request; 0 before the first."""
        return int(self.entry[slot]) & OP_MASK

    def ops(self, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """Operations of the current requests of `slots`."""
        return self.entry[slots] & _OP

    def host_of(self, slot: int) -> int:
        """Number of the host of a slot."""
        return self._host_of.item(slot)

    def is_idle(self, slot: int) -> bool:
        """Whether nothing was asked of a slot, and nothing of it waits to be collected."""
        return bool(self.state[slot] == _IDLE_CODE)

    def first_not_idle(self, slots: NDArray[np.intp]) -> int | None:
        """The first of `slots` that can't be asked, if any."""
        states = self.state[slots]
        return int(slots[np.flatnonzero(states)[0]]) if np.count_nonzero(states) else None

    def owed(self, slots: NDArray[np.intp]) -> NDArray[np.intp]:
        """Those of `slots` whose reply is outstanding."""
        return slots[self.state[slots] == _BUSY_CODE]

    def ready(self, slots: NDArray[np.intp]) -> NDArray[np.intp]:
        """Those of `slots` whose result lies in the row."""
        return slots[self.state[slots] == _READY_CODE]

    def pending(self, among: NDArray[np.bool_] | None = None) -> tuple[int, int]:
        """How many results for the collector are ready, and how many with those to come.

        Args:
            among: of these slots only.
        """
        if among is None:
            return self.num_ready, self.num_ready + self.num_awaited
        states = self.state[among & (self.owner == COLLECTOR)]
        return int(np.count_nonzero(states == _READY_CODE)), int(np.count_nonzero(states))

    def total_in_flight(self) -> int:
        """Requests of all hosts that are not answered."""
        return sum(self.in_flight)

    # -- asking -------------------------------------------------------------------

    def submit(self, slots: NDArray[np.intp], op: int, owner: int, now: float) -> NDArray[np.int64]:
        """Number the next request of each of `slots`, all idle; their entries."""
        entries = self._renumbered(slots, op)
        self.state[slots] = _BUSY_CODE
        self.sent_ns[slots] = int(now * 1e9)
        if owner:
            self.owner[slots] = owner
        else:
            self.num_awaited += len(slots)
        return entries

    def _renumbered(self, slots: NDArray[np.intp], op: int) -> NDArray[np.int64]:
        if len(slots) == 1:  # As most results come one by one: in a third of the time.
            slot = slots.item()
            self.entry[slot] = (self.entry.item(slot) & ~OP_MASK) + (1 << NUMBER_SHIFT) + op
            return self.entry[slots]
        entries = self.entry[slots]
        entries &= _WITHOUT_OP
        entries += _NEXT[op]
        self.entry[slots] = entries
        return entries

    def into_resets(
        self, slots: NDArray[np.intp], entries: NDArray[np.int64], which: NDArray[np.bool_]
    ) -> None:
        """Make resets of those steps, submitted and not yet handed over, that `which` marks."""
        entries += which  # RESET == STEP + 1
        self.entry[slots] = entries

    def by_host(self, slots: NDArray[np.intp]) -> list[tuple[int, slice]]:
        """Each host with its part of submitted `slots`: in flight from now on.

        One part for each run of slots of one host.
        """
        count = len(slots)
        if not count:
            return []
        hosts = self._host_of[slots]
        first = hosts.item(0)
        if count == 1 or (first == hosts.item(-1) and not np.count_nonzero(hosts != first)):
            self.in_flight[first] += count
            return [(first, slice(None))]
        parts: list[tuple[int, slice]] = []
        start = 0
        for end in (*((hosts[1:] != hosts[:-1]).nonzero()[0] + 1).tolist(), count):
            host_id = hosts.item(start)
            self.in_flight[host_id] += end - start
            parts.append((host_id, slice(start, end)))
            start = end
        return parts

    def step_answered_at_once(self, slot: int, now: float) -> None:
        """Number a step that was executed without being submitted."""
        self._renumbered(self.alone(slot), _STEP)
        self.sent_ns[slot] = int(now * 1e9)

    def answer_at_once(self, slot: int) -> None:
        """Take note that the result of such a step lies in its row, to be handed out."""
        self.state[slot] = _READY_CODE

    def restart(self, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """Ask owed steps and resets anew, as resets; their entries."""
        return self._renumbered(slots, _RESET)

    def lose_host(self, host_id: int) -> None:
        """Nothing of what is in flight there will be answered by it."""
        self.in_flight[host_id] = 0

    def alone(self, slot: int) -> NDArray[np.intp]:
        """One slot as an array of slots."""
        return self._each[slot : slot + 1]

    # -- ending -------------------------------------------------------------------

    def complete(self, reports: Sequence[tuple[int, NDArray[np.int64]]]) -> NDArray[np.intp]:
        """Take note of results that lie in their rows; their slots.

        Late replies, to requests that were asked anew, are dropped.

        Args:
            reports: a host, and the entries of what it has done; in the order of arrival.
        """
        entries = reports[0][1]
        if len(reports) > 1:
            entries = np.concatenate([entries for _, entries in reports])
        slots = (entries >> _OP_BITS) & _SLOT_MASK
        current = self.entry[slots] == entries
        if np.count_nonzero(current) < len(slots):
            slots = slots[current]
            for host_id in {host_id for host_id, _ in reports}:
                self.in_flight[host_id] -= int(np.count_nonzero(self._host_of[slots] == host_id))
        else:
            for host_id, own in reports:
                self.in_flight[host_id] -= len(own)
        self._deliver(slots)
        return slots

    def complete_one(self, host_id: int, entry: int) -> int | None:
        """The same for one; None if it was late."""
        slot = self.end(host_id, entry)
        if slot is not None:
            self._deliver(self.alone(slot))
        return slot

    def end(self, host_id: int, entry: int) -> int | None:
        """The slot whose current request `entry` is; it is no more in flight. None if late."""
        slot = slot_of(entry)
        if self.state[slot] != _BUSY_CODE or self.entry.item(slot) != entry:
            return None
        self.in_flight[host_id] -= 1
        return slot

    def join(self, slot: int, now: float) -> None:
        """Take note of a first result that nobody asked for; the slot is idle."""
        slots = self.alone(slot)
        self.submit(slots, _JOIN, COLLECTOR, now)
        self._deliver(slots)

    def _deliver(self, slots: NDArray[np.intp]) -> None:
        if not len(slots):
            return
        self.answered = True
        self.state[slots] = _READY_CODE
        if not self._tickets:
            self._queue(slots)
        elif len(self._tickets) == 1 and not self.num_awaited:
            (ticket,) = self._tickets.values()
            ticket.remaining -= len(slots)
        else:
            owners = self.owner[slots]
            for owner in set(owners.tolist()):
                mine = slots[owners == owner]
                if owner:
                    self._tickets[owner].remaining -= len(mine)
                else:
                    self._queue(mine)

    def _queue(self, slots: NDArray[np.intp]) -> None:
        self._ready.append(slots)
        self.num_ready += len(slots)
        self.num_awaited -= len(slots)

    def set_value(self, slot: int, value: Any) -> None:
        """Take note of what a call returned."""
        self.answered = True
        owner = int(self.owner[slot])
        if owner == NOBODY:
            self._forget(self.alone(slot))
        else:
            ticket = self._tickets[owner]
            ticket.values[slot] = value
            ticket.remaining -= 1
            self.state[slot] = _SPENT_CODE

    def owners(self, slots: NDArray[np.intp]) -> dict[int, NDArray[np.intp]]:
        """The slots of each owner among `slots`."""
        # Not `np.unique`, which imports a module when it is first called: after a death there
        # may be no descriptor left to read one.
        found: list[int] = sorted({*self.owner[slots].tolist()})
        return {owner: slots[self.owner[slots] == owner] for owner in found}

    def fail(self, slots: NDArray[np.intp], owner: int, fault: EnvFault) -> None:
        """End requests that are in flight no more, all of one owner, in one error."""
        self.answered = True
        if owner > 0:
            ticket = self._tickets[owner]
            ticket.remaining -= len(slots)
            ticket.faults.append(fault)
            self.state[slots] = _SPENT_CODE
            return
        self._forget(slots)
        if owner == COLLECTOR:
            self.num_awaited -= len(slots)
            self.faults.append(fault)

    def withdraw(self, slot: int) -> None:
        """End a request of the collector's in nothing: it knows why."""
        self._forget(self.alone(slot))
        self.num_awaited -= 1

    def _forget(self, slots: NDArray[np.intp]) -> None:
        self.state[slots] = _IDLE_CODE
        self.owner[slots] = COLLECTOR

    # -- the collector ------------------------------------------------------------

    def take(self, most: int, among: NDArray[np.bool_] | None = None) -> NDArray[np.intp]:
        """Slots of ready results for the collector, first come first served.

        Args:
            most: how many at most.
            among: of these slots only.
        """
        taken: list[NDArray[np.intp]] = []
        left: list[NDArray[np.intp]] = []
        count = 0
        while self._ready and count < most:
            slots = self._ready.popleft()
            if among is not None:
                left.append(slots[~among[slots]])
                slots = slots[among[slots]]
            if count + len(slots) > most:
                self._ready.appendleft(slots[most - count :])
                slots = slots[: most - count]
            taken.append(slots)
            count += len(slots)
        if left:
            self._ready.extendleft(slots for slots in reversed(left) if len(slots))
        self.num_ready -= count
        return taken[0] if len(taken) == 1 else np.concatenate(taken)

    def hand_out(self, slots: NDArray[np.intp]) -> None:
        """Take note that results are handed out: their rows may be written again."""
        self.state[slots] = _IDLE_CODE

    def put_back(self, slots: NDArray[np.intp]) -> None:
        """Those of `slots` whose results were not handed out wait for the collector again."""
        kept = self.ready(slots)
        if len(kept):
            self._ready.appendleft(kept)
            self.num_ready += len(kept)

    def joined(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` have a first result that nobody has collected."""
        ready = (self.state[slots] == _READY_CODE) & (self.owner[slots] == COLLECTOR)
        return ready & (self.ops(slots) == _JOIN)

    def take_joined(self, slots: NDArray[np.intp], ticket: Ticket | None) -> None:
        """Give first results that wait for the collector to a call; None drops them."""
        self._ready = deque(kept for q in self._ready if len(kept := q[~np.isin(q, slots)]))
        self.num_ready -= len(slots)
        if ticket is None:
            self.state[slots] = _IDLE_CODE
        else:
            self.owner[slots] = ticket.owner
            ticket.remaining -= len(slots)

    # -- calls that wait for their own replies ------------------------------------

    def open_ticket(self, slots: NDArray[np.intp], *, method: str = "") -> Ticket:
        """A call's claim to what becomes of its requests, which are about to be submitted.

        Args:
            slots: whose requests.
            method: of the envs that is called; empty for steps and resets.
        """
        ticket = Ticket(self._next_ticket, slots, len(slots), method)
        self._next_ticket += 1
        self._tickets[ticket.owner] = ticket
        return ticket

    def method(self, slot: int) -> str:
        """The method whose call is the current request of `slot`, if somebody waits for it."""
        ticket = self._tickets.get(self.owner.item(slot))
        return "" if ticket is None else ticket.method

    def drop(self, ticket: Ticket) -> None:
        """Nothing was submitted for it."""
        del self._tickets[ticket.owner]

    def settle(self, ticket: Ticket) -> None:
        """The call has all that it waited for: results may be handed out, the rest is idle."""
        del self._tickets[ticket.owner]
        self.owner[ticket.slots] = COLLECTOR
        if ticket.calls or ticket.faults:
            self._forget(ticket.slots[self.state[ticket.slots] == _SPENT_CODE])

    def give_up(self, ticket: Ticket) -> None:
        """The call waits no more: the collector gets what was stepped and reset for it."""
        self.settle(ticket)
        slots = ticket.slots
        if ticket.calls:
            self.owner[self.owed(slots)] = NOBODY
            return
        ready = self.ready(slots)
        self.num_awaited += len(self.owed(slots)) + len(ready)
        self.faults.extend(ticket.faults)
        if len(ready):
            self._queue(ready)
