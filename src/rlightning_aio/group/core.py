"""The core: decides what every request, reply and failure means, and never waits.

Operations are generators. Where one can't go on, it yields a `Wait`; the driver blocks
until a source has told something or the time has come, and sends the time back in.
Rule: no I/O beyond handing bytes to hosts, no clock, no event loop. Everything that is
asynchronous and everything that is synchronous runs through this one implementation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import (
    BadAction,
    EnvAway,
    EnvBusy,
    EnvFault,
    EnvRaised,
    GroupClosed,
    NothingPending,
    RLightningError,
)
from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS, AutoReset, whole
from rlightning_aio.group.hint import HINT_AFTER_BATCHES
from rlightning_aio.group.results import collected
from rlightning_aio.group.slots import BUSY, IDLE, READY
from rlightning_aio.group.stats import Stats
from rlightning_aio.group.wait import Operation, Wait, earliest
from rlightning_aio.protocol.rings import OP_BITS, RESET, SLOT_MASK, STEP
from rlightning_aio.protocol.slab import NO_SEED

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.group.actions import Letters
    from rlightning_aio.group.fleet import Fleet
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.hosts.server import ServerHost
    from rlightning_aio.hosts.worker import ErrorText
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.protocol.server_session import Manners
    from rlightning_aio.types import EnvMeta

__all__ = ["Core"]

CALL: Final = 3
JOINED: Final = 4
"""Not a request: the first result of a client, for which nobody asked."""
NOBODY: Final = -1
"""Owner of a call that was given up."""

# 0-d arrays: NumPy takes twice as long over a Python int.
_OP_BITS: Final = np.array(OP_BITS)
_SLOT_MASK: Final = np.array(SLOT_MASK)
Flags: TypeAlias = "list[bool]"


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


class Core:
    """Requests, replies and their rules; see `Fleet` for how hosts come and go.

    Attributes:
        zero_copy: observations are handed out as views where their rows are contiguous.
        info_width: bytes of a row's info that any schema uses.
    """

    def __init__(self, fleet: Fleet, *, zero_copy: bool) -> None:
        self.fleet = fleet
        self.zero_copy = zero_copy
        self.slots = fleet.slots
        self.auto = AutoReset(fleet.slots)
        self.stats = Stats(fleet.slots)
        self._ready: deque[NDArray[np.intp]] = deque()
        self._ready_count = 0
        self._in_flight = 0
        self._faults: deque[EnvFault] = deque()
        self._tickets: dict[int, Ticket] = {}
        self._next_owner = 1
        self._rests: dict[int, Any] = {}
        self._reports: list[NDArray[np.int64]] = []
        self._collecting = False
        self._wanted: list[int] = []
        self._news = False
        self._handed_out = 0
        self.info_width = 0
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

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps that `collect` will answer."""
        self._send_steps(batch, self.slots_of(batch), 0, now)
        if self._wanted:
            # The collector has not asked these envs' workers to wake it.
            self.fleet.watcher.wake()

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

    def on_client(self, host: Host, row: int, meta: EnvMeta, manners: Manners) -> int:
        """See `base.Inbox.on_client`."""
        table, slot = self.slots, host.first_slot + row
        table.christen(slot, meta.env_id)
        table.resets_itself[slot] = meta.autoreset != "disabled"
        has_row = self.fleet.slabs[int(table.slab[slot])].action is not None
        table.by_frame[slot] = manners.free_actions or not has_row
        table.reads_extras[slot] = manners.reads_extras
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

    # -- collect ------------------------------------------------------------------

    def collect(
        self,
        now: float,
        *,
        timeout: float | None,
        wait_all: bool,
        min_results: int,
        max_results: int | None,
        deadline: float | None,
    ) -> Operation[tuple[BatchedData, Flags]]:
        """See `EnvGroup.collect_async`."""
        self.check_open()
        if self._collecting:
            raise RLightningError(
                "another collect_async is already waiting on this group; one collector at a time"
            )
        self._collecting = True
        try:
            end = None if deadline is None else now + deadline
            window = None
            now = yield from self._glance(now)
            while True:
                self._sweep()
                if self._faults:
                    raise self._faults.popleft()
                ready, total = self._ready_count, self._ready_count + self._in_flight
                if not total and not self.fleet.elastic:
                    raise NothingPending(
                        "nothing to collect: no request is outstanding; send one with step_async"
                    )
                most = total if max_results is None else min(total, max_results)
                need = most if wait_all else min(min_results, most)
                if ready and timeout is not None and window is None:
                    window = now + timeout
                open_window = window is not None and now < window and ready < most
                if ready and ready >= need and not open_window:
                    break
                if end is not None and now >= end:
                    raise TimeoutError(
                        f"{ready} of the {max(need, 1)} results needed came within {deadline} s; "
                        "nothing is lost, the next collect_async gets them"
                    )
                few = 1 if timeout is not None else max(need - ready, 1)
                wanted = most - ready if ready and open_window else few
                until = earliest(end, window if open_window else None)
                now = yield from self._wait(wanted, until)
        finally:
            self._collecting = False
        return self._take(most)

    def _sweep(self) -> None:
        """Take in what hosts have ready.

        Invariant: whoever waits looks again, and orders anew, after every reply that is taken
        in; here somebody else takes it.
        """
        self.fleet.lookout.sweep()
        self.absorb()
        if self._news:
            self._news = False
            if self._wanted:
                self.fleet.watcher.wake()

    def _glance(self, now: float) -> Operation[float]:
        """Look at all hosts now and then: who always finds enough ready never has to wait, and
        would never hear of the dead and the hung.
        """
        if self.fleet.overdue(now):
            now = yield Wait(0.0)
            self.fleet.look(now)
        return now

    def _wait(self, wanted: int, until: float | None) -> Operation[float]:
        """One turn of waiting for `wanted` more replies; the time after it."""
        self._wanted.append(wanted)
        try:
            # Whoever else waits meanwhile must be woken as early as it asked for.
            fleet, first = self.fleet, min(self._wanted)
            look = fleet.lookout
            if look.inline_waits():
                now = yield Wait(0.0)  # Others have their turn while it computes, if it does.
                look.run_inline(wanted)
                fleet.look(now)
                return now
            if look.spin(first) or look.order(first):
                now = yield Wait(0.0)
                fleet.look(now)
                return now
            now = yield Wait(earliest(until, fleet.next_check()))
            look.slept()
        finally:
            self._wanted.remove(wanted)
        fleet.check(now)
        return now

    def _take(self, most: int) -> tuple[BatchedData, Flags]:
        """Hand out up to `most` ready results, first come first served."""
        taken: list[NDArray[np.intp]] = []
        count = 0
        while self._ready and count < most:
            slots = self._ready.popleft()
            if count + len(slots) > most:
                self._ready.appendleft(slots[most - count :])
                slots = slots[: most - count]
            taken.append(slots)
            count += len(slots)
        self._ready_count -= count
        slots = taken[0] if len(taken) == 1 else np.concatenate(taken)
        return self._hand_out(slots, synchronous=False)

    def _hand_out(self, slots: NDArray[np.intp], *, synchronous: bool) -> tuple[BatchedData, Flags]:
        self.slots.state[slots] = IDLE
        batch = collected(self, slots, self._rests)
        flags = self.auto.account(slots, batch)
        self.stats.account(batch.parts, synchronous=synchronous)
        if len(slots):
            self._handed_out += 1
            if self._handed_out % 8 == 0:
                self._note_step(batch, self._handed_out // 8)
            if self._handed_out == HINT_AFTER_BATCHES:
                self.fleet.give_hint(self.stats.summary()["latency_us"])
        return batch, flags

    def _note_step(self, batch: BatchedData, count: int) -> None:
        """Let the lookout know what one result took, now one of this worker and now of that."""
        part = batch.parts[count % len(batch.parts)]
        row = count % len(part)
        host = self.fleet.host_of(part.slots.item(row))
        self.fleet.lookout.note_step(host, part.times.item(row, 1))

    # -- calls that wait for their own replies ------------------------------------

    def _new_ticket(self, slots: NDArray[np.intp], *, calls: bool = False) -> Ticket:
        ticket = Ticket(self._next_owner, slots, len(slots), calls)
        self._next_owner += 1
        self._tickets[ticket.owner] = ticket
        return ticket

    def _await_ticket(self, ticket: Ticket) -> Operation[None]:
        """Until all replies of `ticket` are there. Given up, they go to `collect_async`."""
        try:
            while True:
                self._sweep()
                if ticket.remaining <= 0:
                    break
                yield from self._wait(ticket.remaining, None)
        except BaseException:
            self._disown(ticket)
            raise
        self._tear_up(ticket)

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

    def step(self, batch: BatchedData, now: float) -> Operation[tuple[BatchedData, Flags | None]]:
        """See `EnvGroup.step`."""
        slots = self.slots_of(batch)
        self.fleet.check_local(slots, "step")
        ticket = self._new_ticket(slots)
        try:
            self._send_steps(batch, slots, ticket.owner, now)
        except BaseException:
            del self._tickets[ticket.owner]
            raise
        yield from self._await_ticket(ticket)
        results, flags = self._settled(ticket, slots)
        return results, flags if self.auto.active else None

    def reset(
        self,
        now: float,
        seed: int | Sequence[int] | Mapping[str, int] | None,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> Operation[tuple[BatchedData, Flags]]:
        """See `EnvGroup.reset`."""
        if env_ids is None and self.fleet.elastic:
            yield from self._await_clients(now)
        slots = self._everyone() if env_ids is None else self._distinct(env_ids)
        return (yield from self._reset(now, seed, options, slots))

    def reset_clients(
        self, now: float, listener: ServerHost, seed: int | None, options: dict[str, Any] | None
    ) -> Operation[tuple[BatchedData, Flags]]:
        """See `ServerHandle.reset`."""
        yield from self._await_clients(now)
        slots = np.array(listener.clients(), np.intp) + listener.first_slot
        seeds = None if seed is None else [_checked(seed) + k for k in range(len(slots))]
        return (yield from self._reset(now, seeds, options, slots))

    def _reset(
        self,
        now: float,
        seed: int | Sequence[int] | Mapping[str, int] | None,
        options: dict[str, Any] | None,
        slots: NDArray[np.intp],
    ) -> Operation[tuple[BatchedData, Flags]]:
        table = self.slots
        if self.fleet.elastic:
            self.absorb()
            self.fleet.rank_clients()
        seeds = self._seeds(seed, slots)
        joined = self._has_joined(slots)
        self._check_sendable(slots[~joined], "reset")
        by_letter = options is not None
        packed = self._pack_resets(slots, seeds, options) if by_letter else []
        self.fleet.forget_lost(slots)
        ticket = self._new_ticket(slots)
        asked = slots
        if joined.any():
            enough = seed is None and options is None
            self._take_first_results(slots[joined], ticket, enough=enough)
            if enough:
                asked, seeds = slots[~joined], seeds[~joined]
        self._mark_sent(asked, RESET, ticket.owner, now)
        if by_letter:
            for slot, one in zip(asked.tolist(), packed, strict=True):
                host = self.fleet.host_of(slot)
                host.request_reset(slot - host.first_slot, table.number(slot), one)
        else:
            self.fleet.write_seeds(asked, seeds)
            self._post(asked, table.entry[asked])
        yield from self._await_ticket(ticket)
        return self._settled(ticket, slots)

    def _pack_resets(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any] | None
    ) -> list[Any]:
        return [
            self._pack(slot, (None if seed == NO_SEED else seed, options), "the options")
            for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True)
        ]

    def _everyone(self) -> NDArray[np.intp]:
        """Slots of the local envs and of the clients that are here."""
        clients = self.fleet.clients()
        return np.concatenate((self.slots.all, clients)) if clients else self.slots.all

    def _await_clients(self, now: float) -> Operation[None]:
        """Until each env_server has the clients that it needs."""
        began = now
        while (lacking := self.fleet.lacking(now - began)) is not None:
            now = yield Wait(earliest(began + lacking, self.fleet.next_check()))
            self.fleet.check(now)

    def _take_first_results(self, slots: NDArray[np.intp], ticket: Ticket, *, enough: bool) -> None:
        """Let a reset have the first results of clients that have only just joined.

        Joining was a reset; unless this one asks for more than that, it was `enough`: an env
        that takes minutes to reset, as a robot may, isn't reset twice.
        """
        self._ready = deque(kept for q in self._ready if len(kept := q[~np.isin(q, slots)]))
        self._ready_count -= len(slots)
        if enough:
            self.slots.owner[slots] = ticket.owner
            ticket.remaining -= len(slots)
            return
        self.slots.state[slots] = IDLE
        for slot in slots.tolist():
            self._rests.pop(slot, None)

    def _seeds(
        self, seed: int | Sequence[int] | Mapping[str, int] | None, slots: NDArray[np.intp]
    ) -> NDArray[np.int64]:
        """One seed for each slot: env k gets ``seed + k``, counting sub-environments."""
        table = self.slots
        if seed is None:
            return np.full(len(slots), NO_SEED)
        if isinstance(seed, Mapping):
            given = {table.find_one(env_id): _checked(one) for env_id, one in seed.items()}
            chosen = [given.get(slot, NO_SEED) for slot in slots.tolist()]
        elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
            if len(seed) != len(slots):
                raise ValueError(f"{len(seed)} seeds for {len(slots)} envs; give one for each")
            chosen = [_checked(one) for one in seed]
        else:
            return table.seed_offset[slots] + _checked(seed)
        return np.array(chosen, np.int64)

    def _settled(self, ticket: Ticket, slots: NDArray[np.intp]) -> tuple[BatchedData, Flags]:
        """The results of a call, in its order; its faults, with the results, as an error."""
        if not ticket.faults:
            return self._hand_out(slots, synchronous=True)
        done = slots[self.slots.state[slots] == READY]
        fault = ticket.faults[0]
        fault.others = tuple(ticket.faults[1:])
        if len(done):
            fault.results = self._hand_out(done, synchronous=True)[0]
            fault.add_note(
                f"{len(done)} other envs of the same call are done; their results are in "
                "the error's `results`"
            )
        raise fault

    def call(
        self, now: float, slot: int, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Operation[Any]:
        """Call a method of one env; its value."""
        return (yield from self._call(now, self.slots.alone(slot), name, args, kwargs))

    def call_all(self, now: float, name: str) -> Operation[None]:
        """Call a method of every env, all at once."""
        yield from self._call(now, self.slots.all, name, (), {})

    def _call(
        self,
        now: float,
        slots: NDArray[np.intp],
        name: str,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
    ) -> Operation[Any]:
        """The value of the last call to return."""
        self.fleet.check_local(slots, f"call {name} of")
        self._check_sendable(slots, f"call {name} of")
        chosen = slots.tolist()
        packed = [
            self._pack(slot, (name, args, kwargs), f"the arguments of {name}()") for slot in chosen
        ]
        ticket = self._new_ticket(slots, calls=True)
        self._mark_sent(slots, CALL, ticket.owner, now)
        self.auto.not_completed(slots)
        for slot, one in zip(chosen, packed, strict=True):
            host = self.fleet.host_of(slot)
            host.request_call(slot - host.first_slot, self.slots.number(slot), one)
        yield from self._await_ticket(ticket)
        if ticket.faults:
            ticket.faults[0].others = tuple(ticket.faults[1:])
            raise ticket.faults[0]
        return ticket.value

    def pending(self) -> int:
        """Requests that `collect_async` has still to answer, ready or not."""
        return self._in_flight + self._ready_count

    def check_open(self) -> None:
        """Raises `GroupClosed` before `init` and after `close`."""
        if not self.fleet.open:
            raise GroupClosed(
                "this group is closed; build a new one"
                if self.fleet.closed
                else "this group has not been initialised; call init() first, or use it in a "
                "with block"
            )


def _checked(seed: Any) -> int:
    """`seed` as an int that every env can count on from."""
    value = whole(seed)
    if value is None or not 0 <= value < 1 << 62:
        raise ValueError(f"a seed must be an int from 0 to 2**62 - 1, not {seed!r}")
    return value


def _first_double(ids: Sequence[str]) -> str:
    seen: set[str] = set()
    for id_ in ids:
        if id_ in seen:
            return id_
        seen.add(id_)
    raise AssertionError("no id comes twice")
