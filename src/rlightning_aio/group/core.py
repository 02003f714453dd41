"""The core: decides what every request, reply and failure means, and never waits.

Operations are generators. Where one can't go on, it yields a `Wait`; the driver blocks
until a source has told something or the time has come, and sends the time back in.
Rule: no I/O beyond handing bytes to hosts, no clock, no event loop. Everything that is
asynchronous and everything that is synchronous runs through this one implementation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rlightning_aio.errors import (
    NothingPending,
    RLightningError,
)
from rlightning_aio.group.auto_reset import as_int
from rlightning_aio.group.hint import HINT_AFTER_BATCHES
from rlightning_aio.group.ledger import CALL, Ledger, Ticket
from rlightning_aio.group.results import collected
from rlightning_aio.group.slots import IDLE, READY
from rlightning_aio.group.stats import Stats
from rlightning_aio.group.wait import Operation, Wait, earliest
from rlightning_aio.protocol.rings import RESET
from rlightning_aio.protocol.slab import NO_SEED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.fleet import Fleet
    from rlightning_aio.hosts.server import ServerHost

__all__ = ["Core"]

Flags: TypeAlias = "list[bool]"


class Core(Ledger):
    """What an `EnvGroup` can be asked to do.

    Attributes:
        zero_copy: observations are handed out as views where their rows are contiguous.
    """

    def __init__(self, fleet: Fleet, *, zero_copy: bool) -> None:
        super().__init__(fleet)
        self.zero_copy = zero_copy
        self.stats = Stats(fleet.slots)
        self._collecting = False
        self._handed_out = 0

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps that `collect` will answer."""
        self._send_steps(batch, self.slots_of(batch), 0, now)
        if self._wanted:
            # The collector has not asked these envs' workers to wake it.
            self.fleet.watcher.wake()

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
            if look.run_inline(wanted) or look.spin(first) or look.order(first):
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


def _checked(seed: Any) -> int:
    """`seed` as an int that every env can count on from."""
    value = as_int(seed)
    if value is None or not 0 <= value < 1 << 62:
        raise ValueError(f"a seed must be an int from 0 to 2**62 - 1, not {seed!r}")
    return value
