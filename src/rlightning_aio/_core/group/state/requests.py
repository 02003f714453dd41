"""`Requests`: the current request of each env, its owner, and its state.

A pure table over slots, the positions of envs in their group. It knows hosts by number only, no
time and no I/O. An env has one request at a time. Each request ends once, in a result, a value or
an error for the call that waits for it, or else for `collect`; or it is dropped. `LEGAL` lists
every transition: tests are generated from it, and the random programs execute it.

The table consists of arrays, so that a batch of thousands costs a few vector operations.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from rlightning_aio._core.group.state.conditions import FAULT, Conditions
from rlightning_aio._core.group.state.numbering import Numbering
from rlightning_aio._core.group.state.request_states import COLLECTOR, NOBODY, State
from rlightning_aio.errors import EnvFault
from rlightning_aio.protocol import exchange, kernel
from rlightning_aio.protocol.entries import (
    OP_BITS_ARRAY,
    SLOT_MASK_ARRAY,
    Operation,
    answers_with_value,
    slot_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.protocol.rings import TrainerBell


# Plain ints: NumPy takes several times as long over members of an enum.
_IDLE_CODE, _BUSY_CODE, _READY_CODE, _SPENT_CODE = map(int, State)
_RESET = int(Operation.RESET)


class Ticket(msgspec.Struct):
    """A call that waits for its own requests, independently of `collect`.

    Attributes:
        slots: whose requests; of a ticket that is `apart`, only once its call has left.
        remaining: number of its requests that have not ended.
        apart: it serves many callers, as of `AgentSteps`: each of its requests ends by itself, and
            may end in an error of its own. It stays open while requests come and go.
        ended: slots of an `apart` ticket whose results and errors are to be taken.
        errors: the error that a request ended in, by slot.
        values: returned by method calls, by slot.
    """

    owner: int
    slots: NDArray[np.intp]
    remaining: int
    apart: bool = False
    ended: list[NDArray[np.intp]] = []
    errors: dict[int, EnvFault] = {}
    values: dict[int, Any] = {}

    def own_slots(self, owner: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the slots whose requests are its own, by the `owner` of each request."""
        if self.apart:
            return np.flatnonzero(owner == self.owner)
        return self.slots[owner[self.slots] == self.owner]

    @property
    def faults(self) -> list[EnvFault]:
        """The errors, each once."""
        return list(dict.fromkeys(self.errors.values()))

    def failures(self, slots: NDArray[np.intp]) -> list[tuple[EnvFault, NDArray[np.intp]]]:
        """Return each error of `slots`, with those that it is of."""
        own = set(slots.tolist())
        slots_of = {
            fault: [slot for slot in self.errors if slot in own and self.errors[slot] is fault]
            for fault in self.faults
        }
        return [(fault, np.array(slots, np.intp)) for fault, slots in slots_of.items()]


class Tickets:
    """The calls that wait for their own requests.

    Attributes:
        waiting: by owner.
    """

    def __init__(self) -> None:
        self.waiting: dict[int, Ticket] = {}
        self._next_owner = 1

    def open(self, slots: NDArray[np.intp], *, apart: bool = False) -> Ticket:
        """Open a ticket for a call whose requests are about to be issued.

        Args:
            slots: whose requests.
            apart: as of `Ticket`.
        """
        ticket = Ticket(self._next_owner, slots, len(slots), apart)
        self._next_owner += 1
        self.waiting[ticket.owner] = ticket
        return ticket

    def note_ended(self, owner: int, count: int) -> Ticket:
        """Note that requests of a call have ended; return its ticket."""
        ticket = self.waiting[owner]
        ticket.remaining -= count
        return ticket


class CollectorQueue:
    """The results and errors that wait for the collector, in the order of their arrival.

    An env is busy until its error has been raised, whatever the trainer has read.

    Args:
        conditions: of the group.
        state: `State`, by slot.

    Attributes:
        num_ready: results; num_awaited: requests whose results it will get.
        ready: slots of those results.
        faults: errors, in the order of their arrival.
        errors: by slot, the error that its request ended in.
    """

    def __init__(self, conditions: Conditions, state: NDArray[np.int8]) -> None:
        self._conditions = conditions
        self._state = state
        self.num_ready = 0
        self.num_awaited = 0
        self.ready: deque[NDArray[np.intp]] = deque()
        self.faults: deque[EnvFault] = deque()
        self.errors: dict[int, EnvFault] = {}

    def append(self, slots: NDArray[np.intp]) -> None:
        """Add awaited results that are ready."""
        self.ready.append(slots)
        self.num_ready += len(slots)
        self.num_awaited -= len(slots)

    def pop_ready(self, most: int) -> NDArray[np.intp]:
        """Return the slots of the first `most` results that are ready, in ascending order."""
        taken: list[NDArray[np.intp]] = []
        count = 0
        while self.ready and count < most:
            slots = self.ready.popleft()
            if count + len(slots) > most:
                self.ready.appendleft(slots[most - count :])
                slots = slots[: most - count]
            taken.append(slots)
            count += len(slots)
        self.num_ready -= count
        found = taken[0].copy() if len(taken) == 1 else np.concatenate(taken)
        found.sort()
        return found

    def keep(self, slots: NDArray[np.intp], fault: EnvFault) -> None:
        """Keep an error; the envs of `slots` are busy until it is raised."""
        self._state[slots] = _SPENT_CODE
        self.errors |= dict.fromkeys(slots.tolist(), fault)
        self.faults.append(fault)
        self._conditions.note(FAULT, True)

    def take_fault(self, fault: EnvFault) -> NDArray[np.intp]:
        """Remove an error that is raised; return the slots that it frees."""
        self.faults.remove(fault)
        self._conditions.note(FAULT, bool(self.faults))
        return self.free([slot for slot, own in self.errors.items() if own is fault])

    def free(self, slots: Sequence[int]) -> NDArray[np.intp]:
        """Free those of `slots` whose errors wait, and return them; the errors stay."""
        free = np.array([slot for slot in slots if slot in self.errors], np.intp)
        self._state[free] = _IDLE_CODE
        for slot in free.tolist():
            del self.errors[slot]
        return free


class Requests:
    """See the module.

    Args:
        host_of: the host of each slot, in runs.
        num_hosts: numbered from 0.
        conditions: of the group.

    Attributes:
        hosts: the host of each slot.
        numbering: of each slot's current request; tickets: calls that wait; collector: its queue.
        state: `State`; owner: of the current request.
        sent_ns: when it was sent.
        methods: by slot, the name of the method that was called last.
        in_flight: requests of each host that are not answered; the only count of them.
        rings: of each host, if it is a live worker of this machine; kept up by the hosts.
        unwanted: slots whose requests belong to nobody; the reply of each is dropped.
        anything_ended: something has ended since this was set to False.
    """

    def __init__(
        self, host_of: NDArray[np.int64], num_hosts: int, conditions: Conditions | None = None
    ) -> None:
        size = len(host_of)
        self._each = np.arange(size)
        self.hosts = host_of
        self.numbering = Numbering(size)
        self.tickets = Tickets()
        conditions = conditions or Conditions()
        self.state = np.zeros(size, np.int8)
        self.collector = CollectorQueue(conditions, self.state)
        self.unwanted: set[int] = set()
        self.owner = np.zeros(size, np.int64)
        self.sent_ns = np.zeros(size, np.int64)
        self.methods: dict[int, str] = {}
        self.in_flight = [0] * num_hosts
        self.rings: list[exchange.Ring | None] = [None] * num_hosts
        self._fence = exchange.new_fence()
        self.anything_ended = False

    # -- what is known ------------------------------------------------------------

    def is_idle(self, slot: int) -> bool:
        """Return True if a slot has no request, and no result or error waits to be collected."""
        return bool(self.state[slot] == _IDLE_CODE)

    def first_not_idle(self, slots: NDArray[np.intp]) -> int | None:
        """Return the first of `slots` that is not idle, or None."""
        states = self.state[slots]
        return int(slots[np.flatnonzero(states)[0]]) if np.count_nonzero(states) else None

    def busy_since(self, slot: int) -> float | None:
        """Return when the request was sent that a slot has not answered; None if it has."""
        return self.sent_ns.item(slot) / 1e9 if self.state[slot] == _BUSY_CODE else None

    def owed(self, slots: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the slots of `slots` whose replies are outstanding, the oldest request first."""
        busy = slots[self.state[slots] == _BUSY_CODE]
        return busy[np.argsort(self.sent_ns[busy], kind="stable")]

    def ready(self, slots: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the slots of `slots` whose results are ready."""
        return slots[self.state[slots] == _READY_CODE]

    # -- asking -------------------------------------------------------------------

    def issue(self, slots: NDArray[np.intp], op: int, owner: int, now: float) -> NDArray[np.int64]:
        """Number the next request of each of `slots`, all idle; return their entries."""
        entries = self.numbering.renew(slots, op)
        self.sent_ns[slots] = int(now * 1e9)
        if owner:
            self.owner[slots] = owner
        else:
            self.collector.num_awaited += len(slots)
        self.state[slots] = _BUSY_CODE
        return entries

    def publish(
        self, slots: NDArray[np.intp], resets: NDArray[np.bool_], owner: int, now: float
    ) -> list[exchange.Ring]:
        """Number the next step of each of `slots`, all idle, and put it into the ring of its host.

        Args:
            slots: of envs whose hosts all have rings, and are up.
            resets: ``[n]``, which are reset instead.
            owner: of the requests.
            now: monotonic seconds.

        Returns the rings of the workers that sleep.
        """
        if owner:
            self.owner[slots] = owner
        else:
            self.collector.num_awaited += len(slots)
        return kernel.submit(
            slots,
            resets,
            int(now * 1e9),
            self.numbering.entry,
            self.state,
            self.sent_ns,
            self.hosts,
            self.in_flight,
            self.rings,
            self._fence,
        )

    def put_in_flight(self, slots: NDArray[np.intp]) -> list[tuple[int, slice]]:
        """Count issued requests of `slots` as in flight; return each host with its part of them.

        One part for each run of slots of one host.
        """
        count = len(slots)
        if not count:
            return []
        if len(self.in_flight) == 1:
            self.in_flight[0] += count
            return [(0, slice(None))]
        hosts = self.hosts[slots]
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

    def ask_again(self, host_id: int, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """Number outstanding steps and resets of a host again, as resets; return their entries.

        They are in flight again.
        """
        self.in_flight[host_id] += len(slots)
        return self.numbering.renew(slots, _RESET)

    def alone(self, slot: int) -> NDArray[np.intp]:
        """Return one slot as an array of slots."""
        return self._each[slot : slot + 1]

    # -- ending -------------------------------------------------------------------

    def read(self, bell: TrainerBell) -> bool:
        """Read the reports in the rings, and record the results that are in their rows.

        Returns False, without reading anything, if other reports come first, or any is late.
        """
        slots = kernel.complete(
            bell.counters, bell.read, self.numbering.entry, self.in_flight, self.rings, self._fence
        )
        if slots is None:
            return False
        self.deliver(self.drop_unwanted(slots) if self.unwanted else slots)
        return True

    def complete(self, reports: Sequence[tuple[int, NDArray[np.int64]]]) -> NDArray[np.intp]:
        """Record results that are in their rows; return their slots.

        Late replies, to requests that were asked again, are dropped, and so are unwanted ones.

        Args:
            reports: a host, and the entries of what it has done; in the order of arrival.
        """
        entries = reports[0][1]
        if len(reports) > 1:
            entries = np.concatenate([entries for _, entries in reports])
        slots = entries >> OP_BITS_ARRAY
        slots &= SLOT_MASK_ARRAY
        # A slot beyond the last one is compared with the last one's entry, which differs.
        current = self.numbering.entry.take(slots, mode="clip") == entries
        if np.count_nonzero(current) < len(slots):
            slots = slots[current]
            for host_id in {host_id for host_id, _ in reports}:
                self.in_flight[host_id] -= int(np.count_nonzero(self.hosts[slots] == host_id))
        else:
            for host_id, own in reports:
                self.in_flight[host_id] -= len(own)
        if self.unwanted:
            slots = self.drop_unwanted(slots)
        self.deliver(slots)
        return slots

    def is_current(self, entry: int) -> bool:
        """Return True if the request `entry` is the one in flight to its slot."""
        slot = slot_of(entry)
        return self.state.item(slot) == _BUSY_CODE and self.numbering.entry.item(slot) == entry

    def end(self, host_id: int, entry: int) -> int | None:
        """End the request `entry`, and return its slot; None if its reply is unwanted."""
        slot = slot_of(entry)
        if not self.is_current(entry):
            return None
        self.in_flight[host_id] -= 1
        if slot in self.unwanted:
            self.drop_unwanted(self.alone(slot))
            return None
        return slot

    def drop(self, slots: NDArray[np.intp]) -> None:
        """End requests of `slots` without an outcome; none is in flight, and nobody waits for it.

        Results that the collector has not taken are dropped, too.
        """
        is_ready = self.state[slots] == _READY_CODE
        collector, owners = self.collector, self.owner[slots]
        if np.count_nonzero(is_ready):
            gone = slots[is_ready]
            collector.ready = deque(
                kept for q in collector.ready if len(kept := q[~np.isin(q, gone)])
            )
            collector.num_ready -= len(gone)
        collector.num_awaited -= int(np.count_nonzero((owners == COLLECTOR) & ~is_ready))
        for owner in {*owners[owners > 0].tolist()}:
            mine = slots[owners == owner]
            ticket = self.tickets.note_ended(owner, len(mine))
            ticket.slots = ticket.slots[~np.isin(ticket.slots, mine)]
        self.unwanted.difference_update(slots[owners == NOBODY].tolist())
        self._free(slots)
        self.anything_ended = True

    def drop_unwanted(self, slots: NDArray[np.intp]) -> NDArray[np.intp]:
        """Drop those of `slots` that belong to nobody, none in flight; return the others."""
        is_dropped = self.owner[slots] == NOBODY
        self.drop(slots[is_dropped])
        return slots[~is_dropped]

    def abort(self, slots: NDArray[np.intp], faults: Sequence[EnvFault]) -> None:
        """Give outstanding requests to nobody; a call that waits for one gets its error."""
        each: list[int] = slots.tolist()
        fault_of = dict(zip(each, faults, strict=True))
        for owner, mine in self.owners(slots):
            if owner > 0:
                ticket = self.tickets.note_ended(owner, len(mine))
                ticket.slots = ticket.slots[~np.isin(ticket.slots, mine)]
                ticket.errors.update((slot, fault_of[slot]) for slot in mine.tolist())
            elif owner == COLLECTOR:
                self.collector.num_awaited -= len(mine)
        self.owner[slots] = NOBODY
        self.unwanted.update(each)
        self.anything_ended = True

    def deliver(self, slots: NDArray[np.intp]) -> None:
        """Deliver the results of `slots`, which are no longer in flight, to their owners."""
        if not len(slots):
            return
        self.anything_ended = True
        self.state[slots] = _READY_CODE
        collector, tickets = self.collector, self.tickets.waiting
        if not tickets:  # As `CollectorQueue.append`, without a call.
            collector.ready.append(slots)
            collector.num_ready += len(slots)
            collector.num_awaited -= len(slots)
        elif len(tickets) == 1 and not collector.num_awaited:
            (ticket,) = tickets.values()
            ticket.remaining -= len(slots)
            if ticket.apart:
                ticket.ended.append(slots)
        else:
            owners = self.owner[slots]
            found: list[int] = owners.tolist()
            for owner, count in Counter(found).items():
                if owner == COLLECTOR:
                    collector.append(slots[owners == owner])
                elif (ticket := self.tickets.note_ended(owner, count)).apart:
                    ticket.ended.append(slots[owners == owner])

    def set_value(self, slot: int, value: Any) -> None:
        """Record the value of a method call."""
        self.anything_ended = True
        ticket = self.tickets.note_ended(int(self.owner[slot]), 1)
        ticket.values[slot] = value
        if ticket.apart:
            ticket.ended.append(self.alone(slot))
        self.state[slot] = _SPENT_CODE

    def owners(self, slots: NDArray[np.intp]) -> list[tuple[int, NDArray[np.intp]]]:
        """Return each owner among `slots`, with those that have an error in common."""
        # `np.unique` would import a module at its first call, and after a death there may be no
        # free descriptor to read it.
        found: list[int] = sorted({*self.owner[slots].tolist()})
        each: list[tuple[int, NDArray[np.intp]]] = []
        for owner in found:
            mine = slots[self.owner[slots] == owner]
            if owner > 0 and self.tickets.waiting[owner].apart:
                each += [(owner, self.alone(slot)) for slot in mine.tolist()]
            else:
                each.append((owner, mine))
        return each

    def fail(self, slots: NDArray[np.intp], owner: int, fault: EnvFault) -> None:
        """End requests of one owner that are no longer in flight, in one error."""
        self.anything_ended = True
        if owner > 0:
            ticket = self.tickets.note_ended(owner, len(slots))
            ticket.errors |= dict.fromkeys(slots.tolist(), fault)
            if ticket.apart:
                ticket.ended.append(slots)
            self.state[slots] = _SPENT_CODE
        else:
            self.collector.num_awaited -= len(slots)
            self.collector.keep(slots, fault)

    def _free(self, slots: NDArray[np.intp]) -> None:
        self.state[slots] = _IDLE_CODE
        self.owner[slots] = COLLECTOR

    # -- the collector ------------------------------------------------------------

    def hand_out(self, slots: NDArray[np.intp]) -> None:
        """Record that results were returned: their rows may be written again."""
        self.state[slots] = _IDLE_CODE

    # -- calls that wait for their own replies ------------------------------------

    def close(self, ticket: Ticket) -> None:
        """Close a ticket that has all replies: results may be returned, the rest is idle."""
        del self.tickets.waiting[ticket.owner]
        self.owner[ticket.slots] = COLLECTOR
        if ticket.values or ticket.errors:
            self._free(ticket.slots[self.state[ticket.slots] == _SPENT_CODE])

    def take_ended(self, ticket: Ticket) -> NDArray[np.intp]:
        """Take what has ended out of a ticket that stays open; return the slots of the results."""
        if not ticket.ended:
            return self._each[:0]
        ended = ticket.ended[0] if len(ticket.ended) == 1 else np.concatenate(ticket.ended)
        ticket.ended.clear()
        self.owner[ended] = COLLECTOR
        states = self.state[ended]
        self._free(ended[states == _SPENT_CODE])
        return ended[states == _READY_CODE]

    def split(self, ticket: Ticket, slot: int) -> Ticket:
        """Move the request of one slot out of a ticket that is `apart`, into one of its own."""
        slots = self.alone(slot)
        own = self.tickets.open(slots)
        self.owner[slots] = own.owner
        ticket.remaining -= int(self.state[slot] == _BUSY_CODE)
        ticket.ended = [kept for one in ticket.ended if len(kept := one[one != slot])]
        for found, its in ((ticket.errors, own.errors), (ticket.values, own.values)):
            if slot in found:
                its[slot] = found.pop(slot)
        return own

    def leave(self, ticket: Ticket) -> None:
        """Close a ticket that no longer waits: its steps and resets go to the collector.

        Values of methods are for nobody else.
        """
        slots = ticket.slots = ticket.own_slots(self.owner)
        calls = self.numbering.awaits_value(slots)
        self.close(ticket)
        called = self.owed(slots[calls])
        self.owner[called] = NOBODY
        self.unwanted.update(called.tolist())
        slots = slots[~calls]
        ready = self.ready(slots)
        self.collector.num_awaited += len(self.owed(slots)) + len(ready)
        for slot in [*ticket.errors]:
            if answers_with_value(self.numbering.op(slot)):
                del ticket.errors[slot]
        for fault, its in ticket.failures(slots):
            self.collector.keep(its, fault)
        if len(ready):
            self.collector.append(ready)
