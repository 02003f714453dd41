"""`Ledger`: what was asked of each env, for whom, and what has come of it.

Rule: one request in flight for each env; every one of them ends once, in a result, an
error or a withdrawal, and goes to the call that waits for it or else to `collect`.
Absent on purpose: waiting, and what a batch of results means. Those are the core's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import (
    BadAction,
    EnvAway,
    EnvBusy,
    EnvFault,
    EnvRaised,
    GroupClosed,
)
from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS, AutoReset
from rlightning_aio.group.slots import BUSY, IDLE, READY
from rlightning_aio.protocol.rings import OP_BITS, RESET, SLOT_MASK, STEP

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.group.actions import Letters
    from rlightning_aio.group.fleet import Fleet
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.hosts.worker import ErrorText
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.protocol.net.server_session import ClientTraits
    from rlightning_aio.types import EnvMeta

__all__ = ["CALL", "Ledger", "Ticket"]

CALL: Final = 3
JOINED: Final = 4
"""Not a request: the first result of a client, for which nobody asked."""
NOBODY: Final = -1
"""Owner of a call that was given up."""

# 0-d arrays: NumPy takes twice as long over a Python int.
_OP_BITS: Final = np.array(OP_BITS)
_SLOT_MASK: Final = np.array(SLOT_MASK)


@dataclass(slots=True)
class Ticket:
    """What waits for requests of its own, beside `collect_async`.

    Attributes:
        calls: they are calls of methods.
        spent: slots whose reply was an error or a value, so that no result is left in a row.
    """

    owner: int
    slots: NDArray[np.intp]
    remaining: int
    calls: bool = False
    spent: list[int] = field(default_factory=list[int])
    faults: list[EnvFault] = field(default_factory=list[EnvFault])
    value: Any = None


class Ledger:
    """Requests and replies; see `Fleet` for how hosts come and go.

    Attributes:
        info_width: bytes of a row's info that any schema uses.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.slots = fleet.slots
        self.auto = AutoReset(fleet.slots)
        self.info_width = 0
        # Results that nobody's ticket is for, in order, and how many; and errors likewise.
        self._ready: deque[NDArray[np.intp]] = deque()
        self._ready_count: int = 0
        self._faults: deque[EnvFault] = deque()
        # Requests that `collect` will answer.
        self._in_flight = 0
        self._tickets: dict[int, Ticket] = {}
        self._next_owner = 1
        self._rests: dict[int, Any] = {}
        self._reports: list[NDArray[np.int64]] = []
        # How many results each of those who wait wants; whether anything has ended since.
        self._wanted: list[int] = []
        self._news = False
        fleet.deliver_to(self)

    # -- requests -----------------------------------------------------------------

    def slots_of(self, batch: BatchedData) -> NDArray[np.intp]:
        """Slots of a batch's envs; free for a batch that answers one of ours."""
        slots = batch.slots_in(self)
        if slots is None:
            slots = self._distinct(batch.env_ids())
        return slots

    def _distinct(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """Slots of `env_ids`, each of which may come once."""
        slots = self.slots.find(env_ids)
        if slots is not self.slots.all and len(set(env_ids)) < len(slots):
            raise EnvBusy(f"{_first_double(env_ids)!r} comes twice in one call; nothing was sent")
        return slots

    def _check_sendable(self, slots: NDArray[np.intp], what: str) -> None:
        self.check_open()
        self.fleet.check_usable(slots)
        table = self.slots
        states = table.state[slots]
        if np.count_nonzero(states):
            slot = int(slots[np.flatnonzero(states)[0]])
            state = "has not replied yet" if table.state[slot] == BUSY else "was not collected"
            raise EnvBusy(
                f"can't {what} {table.describe(slot)}: its last request {state}; collect it first"
                "; nothing was sent"
            )

    def check_open(self) -> None:
        """Raises `GroupClosed` before `init` and after `close`."""
        if not self.fleet.open:
            raise GroupClosed(
                "this group is closed; build a new one"
                if self.fleet.closed
                else "this group has not been initialised; call init() first, or use it in a "
                "with block"
            )

    def _send_steps(
        self, batch: BatchedData, slots: NDArray[np.intp], owner: int, now: float
    ) -> None:
        table = self.slots
        if self.fleet.elastic:
            self.absorb()
            if self._ready_count:
                batch, slots = self._without_returned(batch, slots)
            if not len(slots):
                return
        self._check_sendable(slots, "step")
        letters = write_actions(batch, slots, table, self.fleet.slabs)
        packed = [] if letters is None else self._pack_letters(slots, letters)
        resets = self.auto.due(slots)
        if self.fleet.lost:
            resets = resets | self.fleet.claim_lost(slots)
        if letters is None:
            self._send_entries(slots, resets, owner, now)
            return
        by_letter = np.zeros(len(slots), np.bool_)
        by_letter[letters.positions] = True
        by_letter &= ~resets
        plain = ~by_letter
        if plain.any():
            chosen = resets if resets is NO_RESETS else resets[plain]
            self._send_entries(slots[plain], chosen, owner, now)
        for position, letter in zip(letters.positions.tolist(), packed, strict=True):
            if by_letter[position]:
                slot = int(slots[position])
                self._mark_sent(slots[position : position + 1], STEP, owner, now)
                host = self.fleet.host_of(slot)
                host.request_step(slot - host.first_slot, table.number(slot), letter)

    def _without_returned(
        self, batch: BatchedData, slots: NDArray[np.intp]
    ) -> tuple[BatchedData, NDArray[np.intp]]:
        """`batch` without the clients that have come back since it was decided upon.

        What they would be asked was meant for the episode that they have lost; the first
        result of the new one, which waits to be collected, is their answer.
        """
        returned = self._has_joined(slots)
        if not returned.any():
            return batch, slots
        kept = np.flatnonzero(~returned).tolist()
        env_ids, values = batch.env_ids(), batch.values()
        return BatchedData([env_ids[k] for k in kept], [values[k] for k in kept]), slots[kept]

    def _has_joined(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` have a first result that nobody has collected."""
        return (self.slots.ops(slots) == JOINED) & (self.slots.state[slots] == READY)

    def _pack_letters(self, slots: NDArray[np.intp], letters: Letters) -> list[Any]:
        """What the channel will carry, pickled before anything is sent."""
        chosen = slots[letters.positions].tolist()
        try:
            for slot, (action, _) in zip(chosen, letters.contents, strict=True):
                self.fleet.check_step(slot, action)
            return [
                self._pack(slot, content, "the response")
                for slot, content in zip(chosen, letters.contents, strict=True)
            ]
        except TypeError as error:
            raise BadAction(str(error)) from error

    def _pack(self, slot: int, content: Any, what: str) -> Any:
        try:
            return self.fleet.host_of(slot).pack(content)
        except Exception as error:
            raise TypeError(
                f"{what} for {self.slots.describe(slot)} can't be sent to its worker: {error}; "
                "nothing was sent"
            ) from error

    def _send_entries(
        self, slots: NDArray[np.intp], resets: NDArray[np.bool_], owner: int, now: float
    ) -> None:
        """Send steps, and resets in place of some, whose arguments lie in the rows."""
        entries = self._mark_sent(slots, STEP, owner, now)
        if resets is not NO_RESETS and np.count_nonzero(resets):
            entries += resets  # RESET == STEP + 1
            self.slots.entry[slots] = entries
            self.auto.resets_sent(slots[resets])
        self._post(slots, entries)

    def _post(self, slots: NDArray[np.intp], entries: NDArray[np.int64]) -> None:
        """Hand entries to their hosts, with one call for each run of slots of one host."""
        if not len(slots):
            return
        hosts = self.slots.host[slots]
        hosts_of = self.fleet.hosts
        if hosts[0] == hosts[-1] and len(hosts_of) == 1:
            hosts_of[0].request(entries)
            return
        cuts = (hosts[1:] != hosts[:-1]).nonzero()[0]
        start = 0
        for end in (*(cuts + 1).tolist(), len(slots)):
            host_id: int = hosts[start]
            hosts_of[host_id].request(entries[start:end])
            start = end

    def _mark_sent(
        self, slots: NDArray[np.intp], op: int, owner: int, now: float
    ) -> NDArray[np.int64]:
        """Number the next requests of `slots`; their ring entries."""
        table = self.slots
        entries = table.renumber(slots, op)
        table.state[slots] = BUSY
        table.sent_ns[slots] = int(now * 1e9)
        if owner:
            table.owner[slots] = owner
        else:
            self._in_flight += len(slots)
        if op in (RESET, JOINED):
            self.auto.resets_sent(slots)
        return entries

    # -- replies (called by the fleet) --------------------------------------------

    def on_reports(self, entries: NDArray[np.int64]) -> None:
        """See `base.Inbox.on_reports`. They are looked at together, by `absorb`."""
        self._reports.append(entries)

    def absorb(self) -> None:
        """Look at what hosts have reported since the last time."""
        reports = self._reports
        if not reports:
            return
        entries = reports[0] if len(reports) == 1 else np.concatenate(reports)
        reports.clear()
        slots = (entries >> _OP_BITS) & _SLOT_MASK
        current = self.slots.entry[slots] == entries
        if np.count_nonzero(current) < len(slots):
            slots = slots[current]  # Late replies to requests that were given up.
        self._replied(slots)

    def on_rest(self, host: Host, row: int, number: int, rest: bytes | dict[str, Any]) -> None:
        """See `base.Inbox.on_rest`."""
        slot = host.first_slot + row
        if self._is_current(slot, number):
            if rest:
                self._rests[slot] = rest
            self._replied(self.slots.alone(slot))

    def on_value(self, host: Host, row: int, number: int, value: Any) -> None:
        """See `base.Inbox.on_value`."""
        slot = host.first_slot + row
        if self._is_current(slot, number):
            self._news = True
            owner = int(self.slots.owner[slot])
            if owner == NOBODY:
                self.slots.owner[slot] = self.slots.state[slot] = 0
                return
            self.slots.state[slot] = READY
            ticket = self._tickets[owner]
            ticket.value = value
            ticket.spent.append(slot)
            ticket.remaining -= 1

    def on_error(self, host: Host, row: int, number: int, error: ErrorText) -> None:
        """See `base.Inbox.on_error`."""
        slot = host.first_slot + row
        if not self._is_current(slot, number):
            return
        self._fail_one(slot, self._raised(slot, error))

    def _raised(self, slot: int, error: ErrorText) -> EnvRaised:
        """What the caller is told of `error`, in which the current request of `slot` ended."""
        doing = {STEP: "step", RESET: "reset", CALL: "call"}[self.slots.op(slot)]
        death = self.fleet.restarting.pop(slot, None)
        after = f" (its worker {death.cause}, and was replaced)" if death else ""
        return EnvRaised(
            f"{self.slots.describe(slot)} raised in {doing}: {error.type_name}: {error.text}"
            f"{after}; the remote traceback is above; reset the env to go on",
            env_id=self.slots.env_ids[slot],
            exception_type=error.type_name,
            exception_text=error.text,
            traceback_text=error.traceback,
        )

    def on_schema(self, host: Host, number: int, schema: InfoSchema) -> None:
        """See `base.Inbox.on_schema`."""
        self.slots.schemas[host.first_slot][number] = schema
        self.info_width = max(self.info_width, schema.size)

    def on_client(self, host: Host, row: int, meta: EnvMeta, traits: ClientTraits) -> int:
        """See `base.Inbox.on_client`."""
        table, slot = self.slots, host.first_slot + row
        table.christen(slot, meta.env_id)
        table.resets_itself[slot] = meta.autoreset != "disabled"
        has_row = self.fleet.slabs[int(table.slab[slot])].action is not None
        table.by_frame[slot] = traits.free_actions or not has_row
        table.reads_extras[slot] = traits.reads_extras
        table.note_envs()
        if table.state[slot] == IDLE:
            self._mark_sent(self.slots.alone(slot), JOINED, 0, 0.0)
        return int(table.entry[slot])

    def on_withdrawn(self, host: Host, row: int, number: int) -> None:
        """See `base.Inbox.on_withdrawn`."""
        slot = host.first_slot + row
        if not self._is_current(slot, number):
            return
        owner = int(self.slots.owner[slot])
        if owner in self._tickets:
            self._fail_one(slot, EnvAway(self._away(slot), env_id=self.slots.env_ids[slot]))
            return
        self.slots.state[slot] = IDLE
        self.auto.not_completed(self.slots.alone(slot))
        self._in_flight -= 1

    def _away(self, slot: int) -> str:
        return (
            f"the client of {self.slots.describe(slot)} is not connected; its next first result "
            "comes through collect_async when it is back"
        )

    def on_fault(self, host: Host, row: int, number: int, fault: EnvFault) -> None:
        """See `base.Inbox.on_fault`."""
        slot = host.first_slot + row
        if self._is_current(slot, number):
            self._fail_one(slot, fault)

    def detach_infos(self, slots: NDArray[np.intp]) -> None:
        """Decode infos of results that wait here: what can read them is about to change."""
        failed = {slot for ticket in self._tickets.values() for slot in ticket.spent}
        for slot in slots.tolist():
            if slot not in failed:
                self.fleet.detach_info(slot, self._rests)

    def _is_current(self, slot: int, number: int) -> bool:
        table = self.slots
        return table.state[slot] == BUSY and table.number(slot) == number

    def _replied(self, slots: NDArray[np.intp]) -> None:
        """Replies have come: give each to the call that waits for it."""
        if not len(slots):
            return
        table = self.slots
        self._news = True
        table.state[slots] = READY
        if self.fleet.recovering:
            self.fleet.note_restarted(slots, self._rests)
        if len(self._tickets) == 1 and not self._in_flight:
            (ticket,) = self._tickets.values()
            ticket.remaining -= len(slots)
        elif self._tickets:
            owners = table.owner[slots]
            for owner in set(owners.tolist()):
                mine = owners == owner
                if owner:
                    self._tickets[owner].remaining -= int(np.count_nonzero(mine))
                else:
                    self._queue(slots[mine])
        else:
            self._queue(slots)

    def _queue(self, slots: NDArray[np.intp]) -> None:
        self._ready.append(slots)
        self._ready_count += len(slots)
        self._in_flight -= len(slots)

    def _fail_one(self, slot: int, fault: EnvFault) -> None:
        self.fail(self.slots.alone(slot), lambda _: fault)

    def fail(
        self, slots: NDArray[np.intp], error_for: Callable[[NDArray[np.intp]], EnvFault]
    ) -> None:
        """End the outstanding requests of `slots` with one error for each caller."""
        table = self.slots
        self._news = True
        self.auto.not_completed(slots[table.ops(slots) != CALL])
        for owner in set(table.owner[slots].tolist()):
            mine = slots[table.owner[slots] == owner]
            table.state[mine] = IDLE
            if owner == NOBODY:
                table.owner[mine] = 0
            elif owner:
                table.state[mine] = READY
                ticket = self._tickets[owner]
                ticket.spent += mine.tolist()
                ticket.remaining -= len(mine)
                ticket.faults.append(error_for(mine))
            else:
                self._in_flight -= len(mine)
                self._faults.append(error_for(mine))

    # -- calls that wait for their own replies ------------------------------------

    def _new_ticket(self, slots: NDArray[np.intp], *, calls: bool = False) -> Ticket:
        ticket = Ticket(self._next_owner, slots, len(slots), calls)
        self._next_owner += 1
        self._tickets[ticket.owner] = ticket
        return ticket

    def _tear_up(self, ticket: Ticket) -> None:
        del self._tickets[ticket.owner]
        # Invariant: the owner of an idle slot is 0.
        self.slots.owner[ticket.slots] = 0
        if ticket.spent:
            self.slots.state[ticket.spent] = IDLE

    def _disown(self, ticket: Ticket) -> None:
        """The caller has given up: `collect_async` gets what was stepped and reset for it."""
        self._tear_up(ticket)
        if self._wanted:
            self.fleet.watcher.wake()
        table, slots = self.slots, ticket.slots
        if ticket.calls:
            table.owner[slots[table.state[slots] == BUSY]] = NOBODY
            return
        states = table.state[slots]
        self._in_flight += int(np.count_nonzero(states))
        self._faults.extend(ticket.faults)
        ready = slots[states == READY]
        if len(ready):
            self._queue(ready)


def _first_double(ids: Sequence[str]) -> str:
    seen: set[str] = set()
    for id_ in ids:
        if id_ in seen:
            return id_
        seen.add(id_)
    raise AssertionError("no id comes twice")
