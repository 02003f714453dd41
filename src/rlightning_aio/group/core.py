"""The core: decides what every request, reply and failure means, and never waits.

It holds the table of requests, the supervisor of hosts and the poller, none of which calls
it back, and says what follows from what. Its procedures are generators: where one
can't go on, it yields a `Wait`; the driver blocks until a source has told something or the
time has come, has what was told taken in (`drain`), and sends the time back in.
Rule: no I/O beyond handing bytes to hosts, no clock, no event loop. Everything that is
asynchronous and everything that is synchronous runs through this one implementation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio.batch.data import (
    BatchedData,
    Origin,
    batch_of_results,
    columns_of_responses,
    slots_of,
)
from rlightning_aio.batch.sent import columns_of_values
from rlightning_aio.errors import (
    BadAction,
    EnvAway,
    EnvBusy,
    EnvFault,
    EnvRaised,
    NothingPending,
    RLightningError,
)
from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS, AutoReset, as_int
from rlightning_aio.group.hint import HINT_AFTER_BATCHES
from rlightning_aio.group.recovery import Recovery
from rlightning_aio.group.requests import COLLECTOR, State
from rlightning_aio.group.results import Results
from rlightning_aio.group.stats import Stats
from rlightning_aio.group.supervisor import GivenUp, Replaced
from rlightning_aio.group.wait import Procedure, Wait, earliest
from rlightning_aio.hosts.messages import (
    NO_ACTION,
    Attached,
    Built,
    Closed,
    Died,
    ErrorText,
    Failed,
    Joined,
    NewSchema,
    NotBuilt,
    Raised,
    Reported,
    Result,
    Value,
    Withdrawn,
)
from rlightning_aio.protocol.entries import Operation, answers_with_value
from rlightning_aio.protocol.slab import NO_SEED, TRUNCATED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.group.actions import OutOfBandSteps
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.poller import Poller
    from rlightning_aio.group.requests import Requests, Ticket
    from rlightning_aio.group.slab_layout import SlabLayout
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.hosts.base import Host, Membership, Watcher
    from rlightning_aio.hosts.messages import Completions
    from rlightning_aio.types import EnvMeta

__all__ = ["Core", "Flags"]

Flags: TypeAlias = "list[bool]"
Seeds: TypeAlias = "int | Sequence[int] | Mapping[str, int] | None"


class Core:
    """What an `EnvGroup` can be asked to do.

    Args:
        envs, requests, layout: the group's tables.
        supervisor, poller: of its hosts.
        completions: where these tell what has become of requests.
        watcher: the driver.
        zero_copy: observations are handed out as views where their rows are contiguous.
    """

    def __init__(
        self,
        envs: EnvTable,
        requests: Requests,
        layout: SlabLayout,
        supervisor: Supervisor,
        poller: Poller,
        completions: Completions,
        watcher: Watcher,
        *,
        zero_copy: bool,
    ) -> None:
        self.envs = envs
        self.requests = requests
        self.supervisor = supervisor
        self.poller = poller
        self.auto = AutoReset(envs, requests)
        self.stats = Stats(envs, requests)
        self._layout = layout
        self._watcher = watcher
        self._completions = completions
        self._results = Results(envs, layout, zero_copy=zero_copy)
        self._recovery = Recovery()
        # Envs that have come back before the last result of their going was collected.
        self._held_back: dict[int, Joined] = {}
        self._collecting = False
        self._handed_out = 0
        # How many results each call that waits wants.
        self._wanted: list[int] = []
        self._now = 0.0
        self._handlers: dict[type, Callable[[Any], None]] = {
            Reported: self._on_reported,
            Result: self._on_result,
            Value: self._on_value,
            Raised: self._on_raised,
            Failed: self._on_failed,
            Withdrawn: self._on_withdrawn,
            NewSchema: self._on_new_schema,
            Joined: self._on_joined,
            Died: self._on_died,
            **dict.fromkeys((Built, NotBuilt, Attached, Closed), supervisor.handle),
        }

    # -- life -------------------------------------------------------------------------

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """See `EnvGroup.init`."""
        for host in self.supervisor.hosts:
            self._results.begin_schemas(range(host.first_slot, host.first_slot + host.num_envs))
        return self.supervisor.start(now)

    def close(self, now: float) -> Procedure[None]:
        """See `EnvGroup.close`."""
        return self.supervisor.close(now)

    # -- what hosts have told ---------------------------------------------------------

    def drain(self) -> None:
        """Take in what hosts have told. Here, and nowhere else, completions take effect."""
        completions, handlers = self._completions, self._handlers
        while completions:
            told = completions.popleft()
            handlers[type(told)](told)

    def _on_reported(self, told: Reported) -> None:
        reports = [told]
        completions = self._completions
        while completions and type(completions[0]) is Reported:
            reports.append(cast("Reported", completions.popleft()))
        slots = self.requests.complete(reports)
        if self.supervisor.recovering:
            self._note_recovered(slots)

    def _on_result(self, told: Result) -> None:
        slot = self.requests.complete_one(told.host_id, told.entry)
        if slot is not None:
            self._results.keep(slot, told.out_of_band)
            if told.is_loss:
                self._results.mark_lost(slot)
            if self.supervisor.recovering:
                self._note_recovered(self.requests.alone(slot))

    def _on_value(self, told: Value) -> None:
        slot = self.requests.end(told.host_id, told.entry)
        if slot is not None:
            self.requests.set_value(slot, told.value)

    def _on_raised(self, told: Raised) -> None:
        slot = self.requests.end(told.host_id, told.entry)
        if slot is not None:
            self._fail(self.requests.alone(slot), lambda _: self.raised(slot, told.error))

    def raised(self, slot: int, error: ErrorText) -> EnvRaised:
        """What the caller is told of `error`, in which the current request of `slot` ended."""
        cause = self._recovery.told(slot)
        after = f" (its worker {cause}, and was replaced)" if cause else ""
        doing = Operation(self.requests.op(slot)).name.lower()
        return EnvRaised(
            f"{self.envs.describe(slot)} raised in {doing}: {error.type_name}: {error.text}"
            f"{after}; the remote traceback is above; reset the env to go on",
            env_id=self.envs.env_ids[slot],
            exception_type=error.type_name,
            exception_text=error.text,
            traceback_text=error.traceback,
        )

    def _on_failed(self, told: Failed) -> None:
        slot = self.requests.end(told.host_id, told.entry)
        if slot is not None:
            self._fail(self.requests.alone(slot), lambda _: told.fault)

    def _on_withdrawn(self, told: Withdrawn) -> None:
        slot = self.requests.end(told.host_id, told.entry)
        if slot is None:
            return
        if self.requests.owner[slot] == COLLECTOR:
            self.requests.withdraw(slot)
            self.auto.not_completed(self.requests.alone(slot))
            return
        text = (
            f"the client of {self.envs.describe(slot)} is not connected; its next first result "
            "comes through collect_async when it is back"
        )
        away = EnvAway(text, env_id=self.envs.env_ids[slot])
        self._fail(self.requests.alone(slot), lambda _: away)

    def _on_new_schema(self, told: NewSchema) -> None:
        host = self.supervisor.hosts[told.host_id]
        self._results.note_schema(host.first_slot, told.number, told.schema)

    def _on_joined(self, told: Joined) -> None:
        host = self.supervisor.hosts[told.host_id]
        slot = host.first_slot + told.env_index
        if told.slab is not None:
            self._layout.add(told.slab, host.first_slot)
        if not self.requests.is_idle(slot):
            self._held_back[slot] = told
            return
        has_row = self._layout.of(slot)[0].action is not None
        self.envs.note_joined(slot, host.first_slot, told.meta, told.traits, has_row=has_row)
        self.auto.note_joined(slot)
        self.requests.join(slot, self._now)
        self._results.note_sent(self.requests.alone(slot), None)
        self._results.keep(slot, told.write() or {})

    def _fail(
        self, slots: NDArray[np.intp], error_for: Callable[[NDArray[np.intp]], EnvFault]
    ) -> None:
        """End requests that are in flight no more with one error for each caller."""
        self.auto.not_completed(slots[~self._awaits_value(slots)])
        for owner, mine in self.requests.owners(slots).items():
            self.requests.fail(mine, owner, error_for(mine))

    # -- deaths -----------------------------------------------------------------------

    def _on_died(self, told: Died) -> None:
        verdict = self.supervisor.bury(told)
        if isinstance(verdict, GivenUp):
            self._recovery.give_up(_slots_of_host(verdict.host))
            self.supervisor.note_recovery(any_telling=self._recovery.any_telling)
            self._fail(verdict.owed, verdict.error_for)
        elif verdict is not None:
            self._go_on(verdict)

    def _go_on(self, verdict: Replaced) -> None:
        """Have the replacement of a worker answer what its predecessor owed."""
        host, owed = verdict.host, verdict.owed
        slots = _slots_of_host(host)
        for slot in self.requests.ready(np.array(slots, np.intp)).tolist():
            # Decoded now: what can read it is about to change.
            self._results.detach_info(slot)
        self._results.begin_schemas(slots)
        self._recovery.lose(slots, verdict.cause)
        # A replacement answers for steps and resets, but not for calls.
        calls = self._awaits_value(owed)
        self._fail(owed[calls], verdict.error_for)
        owed = owed[~calls]
        if len(owed):
            self._recovery.tell(owed)
            entries = self.requests.restart(owed)
            self._layout.write_seeds(owed, np.full(len(owed), NO_SEED))
            self._hand_over(owed, entries)

    def _awaits_value(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` were asked for a value, and not for a result."""
        ops: list[int] = self.requests.ops(slots).tolist()
        return np.array([answers_with_value(op) for op in ops], np.bool_)

    def _note_recovered(self, slots: NDArray[np.intp]) -> None:
        """Mark replies that come from a replacement; count what shows that it works."""
        for slot in slots.tolist():
            cause = self._recovery.told(slot)
            if cause is not None:
                self._results.mark_restarted(slot, cause)
            elif self.requests.op(slot) == Operation.STEP:
                self.supervisor.note_step(slot)
        self.supervisor.note_recovery(any_telling=self._recovery.any_telling)

    # -- requests ---------------------------------------------------------------------

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps that `collect` will answer."""
        self._send_steps(batch, self._slots_of(batch), None, now)
        if self._wanted:
            # The collector has not asked these envs' workers to wake it.
            self._watcher.wake()

    def _slots_of(self, batch: BatchedData) -> NDArray[np.intp]:
        """Slots of a batch's envs; free for a batch that answers one of ours."""
        slots = slots_of(batch, self)
        return self._distinct(batch.env_ids()) if slots is None else slots

    def _distinct(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """Slots of `env_ids`, each of which may come once."""
        slots = self.envs.find(env_ids)
        if slots is not self.envs.all and len(set(env_ids)) < len(slots):
            double = next(id_ for k, id_ in enumerate(env_ids) if id_ in env_ids[:k])
            raise EnvBusy(f"{double!r} comes twice in one call; nothing was sent")
        return slots

    def _check_sendable(self, slots: NDArray[np.intp], what: str) -> None:
        self.supervisor.check_open()
        self.supervisor.check_usable(slots)
        slot = self.requests.first_not_idle(slots)
        if slot is not None:
            busy = self.requests.state[slot] == State.BUSY
            state = "has not replied yet" if busy else "was not collected"
            raise EnvBusy(
                f"can't {what} {self.envs.describe(slot)}: its last request {state}; collect it "
                "first; nothing was sent"
            )

    def _send_steps(
        self, batch: BatchedData, slots: NDArray[np.intp], ticket: Ticket | None, now: float
    ) -> None:
        self._now = now
        self.drain()
        if self.supervisor.has_members:
            if self.requests.num_ready:
                batch, slots = self._without_returned(batch, slots)
            if not len(slots):
                return
        self._check_sendable(slots, "step")
        out_of_band = write_actions(batch, slots, self.envs, self._layout)
        packed = [] if out_of_band is None else self._packed_steps(slots, out_of_band)
        self._results.note_sent(slots, _columns(batch))
        resets = self.auto.due(slots)
        if self._recovery.any_untold:
            resets = resets | self._recovery.tell(slots)
            self.supervisor.note_recovery(any_telling=self._recovery.any_telling)
        entries = self.requests.submit(slots, Operation.STEP, _owner(ticket), now)
        if resets is not NO_RESETS and np.count_nonzero(resets):
            self.requests.into_resets(slots, entries, resets)
        else:
            resets = None
        if out_of_band is None:
            self._hand_over(slots, entries)
        else:
            self._hand_over_out_of_band(slots, entries, out_of_band.positions, packed, resets)
        if self.supervisor.has_members:
            self.drain()  # What was withdrawn at once.

    def _without_returned(
        self, batch: BatchedData, slots: NDArray[np.intp]
    ) -> tuple[BatchedData, NDArray[np.intp]]:
        """`batch` without the clients that have come back since it was decided upon.

        What they would be asked was meant for the episode that they have lost; the first
        result of the new one, which waits to be collected, is their answer.
        """
        returned = self.requests.joined(slots)
        if not returned.any():
            return batch, slots
        kept = np.flatnonzero(~returned).tolist()
        env_ids, values = batch.env_ids(), batch.values()
        return BatchedData([env_ids[k] for k in kept], [values[k] for k in kept]), slots[kept]

    def _packed_steps(self, slots: NDArray[np.intp], out_of_band: OutOfBandSteps) -> list[Any]:
        """What goes out of band, packed before anything is sent."""
        chosen = slots[out_of_band.positions].tolist()
        try:
            for slot, (action, _) in zip(chosen, out_of_band.contents, strict=True):
                if slot >= len(self.envs.all) and action is not NO_ACTION:
                    host = self._host_of(slot)
                    cast("Membership", host).check_step(slot - host.first_slot, action)
            return [
                self._packed(slot, content, "the response")
                for slot, content in zip(chosen, out_of_band.contents, strict=True)
            ]
        except TypeError as error:
            raise BadAction(str(error)) from error

    def _packed(self, slot: int, arguments: Any, what: str) -> Any:
        try:
            return self._host_of(slot).packed(arguments)
        except Exception as error:
            raise TypeError(
                f"{what} for {self.envs.describe(slot)} can't be sent to its worker: {error}; "
                "nothing was sent"
            ) from error

    def _host_of(self, slot: int) -> Host:
        return self.supervisor.hosts[self.requests.host_of(slot)]

    def _hand_over(
        self,
        slots: NDArray[np.intp],
        entries: NDArray[np.int64],
        arguments: Sequence[Any] | None = None,
    ) -> None:
        """Give submitted requests to their hosts, with one call for each run of one host."""
        hosts = self.supervisor.hosts
        for host_id, part in self.requests.by_host(slots):
            given = None if arguments is None else arguments[part]
            hosts[host_id].submit(entries[part], given)

    def _hand_over_out_of_band(
        self,
        slots: NDArray[np.intp],
        entries: NDArray[np.int64],
        positions: NDArray[np.intp],
        packed: Sequence[Any],
        resets: NDArray[np.bool_] | None,
    ) -> None:
        """The same where `positions` have arguments out of band, unless they became resets."""
        out_of_band = np.zeros(len(slots), np.bool_)
        out_of_band[positions] = True
        if resets is not None:
            out_of_band &= ~resets
        self._hand_over(slots[~out_of_band], entries[~out_of_band])
        kept = out_of_band[positions]
        chosen = positions[kept]
        arguments = [one for one, keep in zip(packed, kept.tolist(), strict=True) if keep]
        self._hand_over(slots[chosen], entries[chosen], arguments)

    # -- waiting ----------------------------------------------------------------------

    def _poll(self) -> None:
        """Take in what hosts have ready.

        Invariant: a call that waits looks again, and arms the bell anew, after every reply that
        is taken in; here another call takes it.
        """
        self.poller.poll()
        self.drain()
        if self.requests.answered:
            self.requests.answered = False
            if self._wanted:
                self._watcher.wake()

    def _check_liveness(self, now: float) -> Procedure[float]:
        """Look at all hosts now and then: a caller that always finds enough ready never has to
        wait, and would never hear of the dead and the hung.
        """
        if self.supervisor.is_overdue(now):
            now = yield Wait(0.0)
            self._check(now)
        return now

    def _check(self, now: float) -> None:
        self._now = now
        if self.supervisor.timed:
            self._poll()  # What is done is not hung.
        self.supervisor.check(now)
        self.drain()

    def _wait(self, wanted: int, now: float, until: float | None) -> Procedure[float]:
        """One turn of waiting for `wanted` more replies; the time after it."""
        self._wanted.append(wanted)
        try:
            # The other calls that wait must be woken as early as they asked for.
            poller, first = self.poller, min(self._wanted)
            if poller.execute(wanted, until) or poller.spin(first):
                return (yield from self._look())
            came, look_again = poller.arm(first, now)
            if came:
                return (yield from self._look())
            now = yield Wait(earliest(until, look_again, self.supervisor.next_check()))
            poller.slept()
        finally:
            self._wanted.remove(wanted)
        self._check(now)
        return now

    def _look(self) -> Procedure[float]:
        """Let other calls that wait have their turn, without blocking."""
        now = yield Wait(0.0)
        if self.supervisor.is_overdue(now):
            self._check(now)
        return now

    def _stop_waiting(self) -> None:
        if not self._wanted:
            self.poller.disarm()

    # -- collect ----------------------------------------------------------------------

    def collect(
        self,
        now: float,
        *,
        timeout: float | None,
        wait_all: bool,
        min_results: int,
        max_results: int | None,
        deadline: float | None,
        entries: Sequence[str] | None = None,
        ordered: bool = False,
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """See `EnvGroup.collect_async`."""
        self.supervisor.check_open()
        if self._collecting:
            raise RLightningError(
                "another collect_async is already waiting on this group; one collector at a time"
            )
        among = None if entries is None else self.envs.of_entries(entries)
        self._collecting = True
        try:
            end = None if deadline is None else now + deadline
            window = None
            now = yield from self._check_liveness(now)
            while True:
                self._poll()
                self._raise_fault(among)
                ready, total = self.requests.pending(among)
                if not total and not self.supervisor.has_members:
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
                now = yield from self._wait(wanted, now, until)
        finally:
            self._collecting = False
            self._stop_waiting()
        slots = self.requests.take(most, among)
        return self._hand_out(np.sort(slots) if ordered else slots, synchronous=False)

    def _raise_fault(self, among: NDArray[np.bool_] | None) -> None:
        """Raise the oldest error for the collector, if there is one of these slots."""
        for fault in self.requests.faults:
            if among is None or among[self.envs.find_one(fault.env_id)]:
                self.requests.faults.remove(fault)
                raise fault

    def _hand_out(self, slots: NDArray[np.intp], *, synchronous: bool) -> tuple[BatchedData, Flags]:
        self.requests.hand_out(slots)
        results = self._results
        parts = results.gather(slots)
        flagged = [part for part in parts if np.count_nonzero(part.flags)]
        limits = self.auto.account(slots, flagged)
        for part in flagged if limits is None else parts:
            if limits is not None:
                part.limit_reached = limits if part.positions is None else limits[part.positions]
                if self.auto.mark_truncated:
                    part.flags[part.limit_reached, ..., TRUNCATED] = True
            results.add_episodes(part)
        self.stats.account(parts, synchronous=synchronous)
        if len(slots):
            self._note_handed_out(parts)
        if self._held_back:
            self._admit(slots)
        origin = Origin(self, slots, self.envs)
        batch = batch_of_results(parts, origin, results.sources(slots))
        return batch, [False] * len(slots) if limits is None else limits.tolist()

    def _note_handed_out(self, parts: Sequence[ResultColumns]) -> None:
        """Now and then, learn from a result how long steps take there."""
        self._handed_out += 1
        turn, is_eighth = self._handed_out // 8, self._handed_out % 8 == 0
        if is_eighth:
            part = parts[turn % len(parts)]
            row = turn % len(part)
            host_id = self.requests.host_of(part.slots.item(row))
            self.poller.note_step(host_id, part.times.item(row, 1))
        if self._handed_out == HINT_AFTER_BATCHES:
            self.supervisor.give_hint(self.stats.summary()["latency_us"])

    def _admit(self, slots: NDArray[np.intp]) -> None:
        """Take in those that have come back to `slots`, whose rows are free now."""
        for slot in slots.tolist():
            if slot in self._held_back:
                self._on_joined(self._held_back.pop(slot)._replace(slab=None))

    # -- calls that wait for their own replies ----------------------------------------

    def _await(self, ticket: Ticket, now: float) -> Procedure[None]:
        """Until all replies of `ticket` are there. Given up, they go to `collect_async`."""
        try:
            while True:
                self._poll()
                if ticket.remaining <= 0:
                    break
                now = yield from self._wait(ticket.remaining, now, None)
        except BaseException:
            self.requests.give_up(ticket)
            if self._wanted:
                self._watcher.wake()
            raise
        finally:
            self._stop_waiting()
        self.requests.settle(ticket)

    def step(self, batch: BatchedData, now: float) -> Procedure[tuple[BatchedData, Flags | None]]:
        """See `EnvGroup.step`."""
        slots = self._slots_of(batch)
        self._check_local(slots, "step")
        ticket = self.requests.open_ticket(slots)
        try:
            self._send_steps(batch, slots, ticket, now)
        except BaseException:
            self.requests.drop(ticket)
            raise
        yield from self._await(ticket, now)
        results, flags = self._settled(ticket, slots)
        return results, flags if self.auto.active else None

    def _check_local(self, slots: NDArray[np.intp], what: str) -> None:
        """Raises NotImplementedError if any of `slots` belongs to a client."""
        if self.supervisor.has_members and (remote := slots[slots >= len(self.envs.all)]).size:
            raise NotImplementedError(
                f"can't {what} {self.envs.describe(int(remote[0]))}: remote envs answer when they "
                "can; use step_async and collect_async"
            )

    def _settled(self, ticket: Ticket, slots: NDArray[np.intp]) -> tuple[BatchedData, Flags]:
        """The results of a call, in its order; its faults, with the results, as an error."""
        if not ticket.faults:
            return self._hand_out(slots, synchronous=True)
        done = self.requests.ready(slots)
        fault = ticket.faults[0]
        fault.others = tuple(ticket.faults[1:])
        if len(done):
            fault.results = self._hand_out(done, synchronous=True)[0]
            fault.add_note(
                f"{len(done)} other envs of the same call are done; their results are in "
                "the error's `results`"
            )
        raise fault

    def reset(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """See `EnvGroup.reset`."""
        if env_ids is None and self.supervisor.has_members:
            now = yield from self._await_members(now)
        slots = self._everyone() if env_ids is None else self._distinct(env_ids)
        return (yield from self._reset(now, seed, options, slots))

    def reset_members(
        self,
        now: float,
        server: tuple[Host, Membership],
        seed: int | None,
        options: dict[str, Any] | None,
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """See `ServerHandle.reset`."""
        now = yield from self._await_members(now)
        host, membership = server
        slots = np.array(membership.member_indices(), np.intp) + host.first_slot
        seeds = None
        if seed is not None:
            self.supervisor.rank_members()
            offsets = self.envs.seed_offset[slots]
            seeds = (_checked(seed) + offsets - offsets[:1]).tolist()
        return (yield from self._reset(now, seeds, options, slots))

    def _everyone(self) -> NDArray[np.intp]:
        """Slots of the local envs and of the clients that are here."""
        members = self.supervisor.member_slots()
        return np.concatenate((self.envs.all, members)) if members else self.envs.all

    def _await_members(self, now: float) -> Procedure[float]:
        """Until each env_server has the clients that it needs."""
        began = now
        while (missing := self.supervisor.missing(now - began)) is not None:
            now = yield Wait(earliest(began + missing, self.supervisor.next_check()))
            self._check(now)
        return now

    def _reset(
        self, now: float, seed: Seeds, options: dict[str, Any] | None, slots: NDArray[np.intp]
    ) -> Procedure[tuple[BatchedData, Flags]]:
        self._now = now
        self.drain()
        if self.supervisor.has_members:
            self.supervisor.rank_members()
        seeds = self._seeds(seed, slots)
        joined = self.requests.joined(slots)
        self._check_sendable(slots[~joined], "reset")
        packed = None if options is None else self._packed_resets(slots, seeds, options)
        self._recovery.forget(slots.tolist())
        ticket = self.requests.open_ticket(slots)
        asked = slots
        if joined.any():
            enough = seed is None and options is None
            self._take_first_results(slots[joined], ticket, enough=enough)
            if enough:
                asked, seeds = slots[~joined], seeds[~joined]
        entries = self.requests.submit(asked, Operation.RESET, ticket.owner, now)
        self._results.note_sent(asked, None)
        if packed is None:
            self._layout.write_seeds(asked, seeds)
        self._hand_over(asked, entries, packed)
        yield from self._await(ticket, now)
        return self._settled(ticket, slots)

    def _packed_resets(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any]
    ) -> list[Any]:
        return [
            self._packed(slot, (None if seed == NO_SEED else seed, options), "the options")
            for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True)
        ]

    def _take_first_results(self, slots: NDArray[np.intp], ticket: Ticket, *, enough: bool) -> None:
        """Let a reset have the first results of clients that have only just joined.

        Joining was a reset; unless this one asks for more than that, it was `enough`: an env
        that takes minutes to reset, as a robot may, isn't reset twice.
        """
        self.requests.take_joined(slots, ticket if enough else None)
        if not enough:
            for slot in slots.tolist():
                self._results.drop(slot)

    def _seeds(self, seed: Seeds, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """One seed for each slot: env k gets ``seed + k``, counting sub-environments."""
        if seed is None:
            return np.full(len(slots), NO_SEED)
        if isinstance(seed, Mapping):
            given = {self.envs.find_one(env_id): _checked(one) for env_id, one in seed.items()}
            chosen = [given.get(slot, NO_SEED) for slot in slots.tolist()]
        elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
            if len(seed) != len(slots):
                raise ValueError(f"{len(seed)} seeds for {len(slots)} envs; give one for each")
            chosen = [_checked(one) for one in seed]
        else:
            return self.envs.seed_offset[slots] + _checked(seed)
        return np.array(chosen, np.int64)

    def call(
        self, now: float, slot: int, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Procedure[Any]:
        """Call a method of one env; its value."""
        return (yield from self._call(now, self.requests.alone(slot), name, args, kwargs))

    def call_all(self, now: float, name: str) -> Procedure[None]:
        """Call a method of every env, all at once."""
        yield from self._call(now, self.envs.all, name, (), {})

    def _call(
        self,
        now: float,
        slots: NDArray[np.intp],
        name: str,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
    ) -> Procedure[Any]:
        """The value of the last call to return."""
        self.drain()
        self._check_local(slots, f"call {name} of")
        self._check_sendable(slots, f"call {name} of")
        arguments = (name, args, kwargs)
        packed = [self._packed(k, arguments, f"the arguments of {name}()") for k in slots.tolist()]
        ticket = self.requests.open_ticket(slots, calls=True)
        entries = self.requests.submit(slots, Operation.CALL, ticket.owner, now)
        self.auto.not_completed(slots)
        self._hand_over(slots, entries, packed)
        yield from self._await(ticket, now)
        if ticket.faults:
            ticket.faults[0].others = tuple(ticket.faults[1:])
            raise ticket.faults[0]
        return ticket.value

    def pending(self) -> int:
        """Requests that `collect_async` has still to answer, ready or not."""
        self.drain()
        return self.requests.pending()[1]


def _slots_of_host(host: Host) -> range:
    return range(host.first_slot, host.first_slot + host.num_envs)


def _owner(ticket: Ticket | None) -> int:
    return COLLECTOR if ticket is None else ticket.owner


def _columns(batch: BatchedData) -> Mapping[str, Any]:
    """What a batch of responses attaches, as columns."""
    columns = columns_of_responses(batch)
    return columns_of_values(batch.values()) if columns is None else columns


def _checked(seed: Any) -> int:
    """`seed` as an int that every env can count on from."""
    value = as_int(seed)
    if value is None or not 0 <= value < 1 << 62:
        raise ValueError(f"a seed must be an int from 0 to 2**62 - 1, not {seed!r}")
    return value
