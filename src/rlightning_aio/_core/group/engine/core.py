"""The core: the operations of a group for every case, without waiting itself.

It connects the parts of a group, none of which calls it back. Its procedures are generators that
yield a `Wait` when they need a reply; the driver blocks until a source is readable or the time has
come, calls `drain`, and sends the time in. Both kinds of group run through it.
Rule: no I/O beyond passing bytes to hosts, no clock, no event loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rlightning_aio._core.group.drivers.wait import Procedure, earliest
from rlightning_aio._core.group.engine.aborts import Aborts
from rlightning_aio._core.group.engine.actions import response_columns, write_actions
from rlightning_aio._core.group.engine.arrivals import Arrivals
from rlightning_aio._core.group.engine.calls import Calls
from rlightning_aio._core.group.engine.dispatch import Dispatch
from rlightning_aio._core.group.engine.first_observations import FirstObservations
from rlightning_aio._core.group.engine.intake import Intake
from rlightning_aio._core.group.engine.newest import Newest
from rlightning_aio._core.group.engine.resets import Resets
from rlightning_aio._core.group.engine.results import Results
from rlightning_aio._core.group.engine.snapshots import Snapshots
from rlightning_aio._core.group.engine.waiting import Waiting
from rlightning_aio._core.group.state.conditions import FIRST_RESULTS
from rlightning_aio._core.group.state.request_states import COLLECTOR, NOBODY, State
from rlightning_aio._core.group.state.stats import Stats
from rlightning_aio.batch.contents import slots_of
from rlightning_aio.batch.data import BatchedData, batch_of_results
from rlightning_aio.errors import BadAction, NothingPending, RLightningError
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.slab import TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import CollectRules
    from rlightning_aio._core.group.engine.poller import Poller
    from rlightning_aio._core.group.episodes.seeds import Seeds
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.base import Membership, Watcher
    from rlightning_aio._core.hosts.messages import Completions
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.errors import EnvFault
    from rlightning_aio.protocol.exchange import Ring
    from rlightning_aio.protocol.rings import TrainerBell
    from rlightning_aio.types import EnvMeta

__all__ = ["Core", "Flags", "Parts"]

Flags: TypeAlias = "list[bool]"


@dataclass(frozen=True)
class Parts:
    """What a core is built from.

    Attributes:
        tables: the state of the group.
        supervisor, poller: of the hosts.
        bell, rings: shared memory; workers post replies in rings, and the bell announces them.
        completions: queue of the outcomes of requests, posted by hosts; a driver applies them
            before it resumes a procedure.
        watcher: the driver.
    """

    tables: Tables
    supervisor: Supervisor
    poller: Poller
    bell: TrainerBell
    rings: list[Ring | None]
    completions: Completions
    watcher: Watcher


class Core:
    """The operations of an `EnvGroup`, correct for every case; methods have its names.

    Args:
        parts: of the group.
        zero_copy: return observations as views if their rows are contiguous.
        shares_thread: other tasks may use the group while a procedure waits.

    Attributes:
        parts, shares_thread: as given; results, intake, waiting, stats, newest: made of them.
        collecting: a call of `collect` waits.
    """

    def __init__(self, parts: Parts, *, zero_copy: bool, shares_thread: bool) -> None:
        self.parts = parts
        self.shares_thread = shares_thread
        tables, supervisor = parts.tables, parts.supervisor
        envs, requests, layout = tables.envs, tables.requests, tables.layout
        continuity, conditions = tables.continuity, tables.conditions
        self._conditions = conditions
        self.envs = envs
        self.requests = requests
        self.supervisor = supervisor
        self.continuity = continuity
        self.observed = tables.observed
        self.lifetime = tables.lifetime
        self.stats = Stats(envs, requests)
        self._layout = layout
        self.results = Results(envs, layout, conditions, zero_copy=zero_copy)
        self._first_observations = FirstObservations(envs)
        self._arrivals = Arrivals(tables, self.results, self.stats)
        self.intake = Intake(parts.completions, tables, supervisor, self.results, self._arrivals)
        self.drain = self.intake.drain
        self.waiting = Waiting(requests, supervisor, parts.poller, self.intake, parts.watcher)
        self._dispatch = Dispatch(
            tables, supervisor, parts.poller, self.intake, self.waiting, parts.watcher
        )
        self.calls = Calls(tables, self._dispatch, self.intake, self.waiting)
        self._snapshots = Snapshots(
            envs, supervisor, self._dispatch, self.calls, continuity, self.waiting
        )
        self._resets = Resets(
            tables, supervisor, self._dispatch, self.results, self.intake, self.waiting
        )
        self._aborts = Aborts(
            tables, supervisor, self.results, self._arrivals, self.intake, self.waiting
        )
        self.newest = Newest(tables, supervisor.members)
        self.collecting = False

    # -- life -------------------------------------------------------------------------

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """Start the hosts."""
        for record in self.supervisor.records:
            self.results.begin_schemas(record.slots)
        with self.observed.call("init", now):
            return (yield from self.supervisor.start(now))

    def close(self, now: float) -> Procedure[None]:
        """Close the hosts."""
        self.supervisor.crash_log.flush(now, everything=True)
        return self.supervisor.shutdown.close(now)

    def describe_workers(self, now_ns: int) -> list[dict[str, Any]]:
        """Describe each host and its outstanding requests."""
        if self.lifetime.open:
            self.waiting.poll()  # Results that are ready are no longer outstanding.
        return self.supervisor.workers.describe(now_ns)

    def awaited(self, now: float) -> str:
        """Say which envs a call waits for."""
        self.waiting.poll()
        return self.supervisor.workers.awaited(int(now * 1e9))

    # -- requests ---------------------------------------------------------------------

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps, whose results `collect` returns."""
        with self.observed.call("step_async", now):
            self._send_steps(batch, self._slots_of(batch), now, None)
        # A waiting collector has not armed the bell for these results.
        self.waiting.wake()

    def _slots_of(self, batch: BatchedData) -> NDArray[np.intp]:
        """Return the slots of a batch's envs; a batch that answers our results knows them."""
        if not isinstance(batch, BatchedData):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise BadAction(
                f"a step takes a batch of responses, not a {type(batch).__name__}: answer the last "
                "results with batch.respond(action=...); nothing was sent"
            )
        slots = slots_of(batch, self)
        return self._dispatch.distinct(_answered(batch)) if slots is None else slots

    def _send_steps(
        self, batch: BatchedData, slots: NDArray[np.intp], now: float, ticket: Ticket | None
    ) -> None:
        self.intake.now = now
        self.intake.drain()
        if self.supervisor.members.possible:
            batch, slots = self._arrivals.without_gone(batch, slots)
            if not len(slots):
                return
        self._dispatch.check_sendable(now, slots, "step")
        out_of_band = write_actions(batch, slots, self.envs, self._layout)
        packed = [] if out_of_band is None else self._dispatch.packed_steps(slots, out_of_band)
        self.results.note_sent(slots, response_columns(batch, slots, self._layout))
        resets = self.continuity.begin_steps(slots)
        if self.continuity.exceptional:
            reports, seeds = self.continuity.report_losses(slots, ~resets)
            self._layout.write_seeds(slots[reports], seeds[reports])
            resets = resets | reports
        owner = COLLECTOR if ticket is None else ticket.owner
        entries = self.requests.submit(slots, Operation.STEP, owner, now)
        if np.count_nonzero(resets):
            self.requests.numbering.into_resets(slots, entries, resets)
        if out_of_band is None:
            self._dispatch.hand_over(slots, entries)
        else:
            self._dispatch.hand_over_out_of_band(
                slots, entries, out_of_band.positions, packed, resets
            )
        if self.supervisor.members.possible:
            self.intake.drain()  # Requests to absent envs are withdrawn immediately.

    # -- collect ----------------------------------------------------------------------

    def collect(self, now: float, rules: CollectRules) -> Procedure[tuple[BatchedData, Flags]]:
        """Wait for results by the rules of `EnvGroup.collect_async`, and return them."""
        with self.observed.call("collect_async", now):
            return (yield from self._collect(now, rules))

    def _collect(self, now: float, rules: CollectRules) -> Procedure[tuple[BatchedData, Flags]]:
        timeout, deadline = rules.timeout, rules.deadline
        self.lifetime.check_open()
        self._check_collecting()
        among = None if rules.entries is None else self.envs.of_entries(rules.entries)
        self.collecting = True
        try:
            end = None if deadline is None else now + deadline
            window = None
            now = yield from self.waiting.check_liveness(now)
            while True:
                ready, most, need = self._counts(rules, among)
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
                now = yield from self.waiting.turn(wanted, until)
        finally:
            self.collecting = False
            self.waiting.end()
        slots = self.requests.collector.take(most, among)
        return self.hand_out(np.sort(slots) if rules.ordered else slots, synchronous=False)

    def _check_collecting(self) -> None:
        if self.collecting:
            raise RLightningError(
                "another collect_async is already waiting on this group; one collector at a time"
            )

    def _counts(self, rules: CollectRules, among: NDArray[np.bool_] | None) -> tuple[int, int, int]:
        """Read replies; return the numbers of results that are ready, possible, and needed.

        Raises:
            EnvFault: an env of these slots ended in an error.
            NothingPending: no result can come.
        """
        self.waiting.poll()
        if self.requests.collector.faults:
            self._raise_fault(among)
        ready, total = self.requests.pending(among)
        if not total and not self.supervisor.members.possible:
            whose = "" if rules.entries is None else f" of entries {', '.join(rules.entries)}"
            raise NothingPending(
                f"nothing to collect: no request{whose} is outstanding; send one with step_async"
            )
        most = total if rules.max_results is None else min(total, rules.max_results)
        return ready, most, most if rules.wait_all else min(rules.min_results, most)

    def _raise_fault(self, among: NDArray[np.bool_] | None) -> None:
        """Raise the collector's oldest error of these slots, if there is one."""
        for fault in self.requests.collector.faults:
            if among is None or among[self.envs.one_of_entry(fault.env_id)]:
                self._note_raised(fault)
                raise fault

    def _note_raised(self, fault: EnvFault) -> None:
        """Note that an error of the collector is raised, so that its envs are free."""
        self._arrivals.admit(self.requests.collector.take_fault(fault), self.intake.now)

    def hand_out(self, slots: NDArray[np.intp], *, synchronous: bool) -> tuple[BatchedData, Flags]:
        """Return the results of `slots`, all ready.

        They stay ready until the batch is complete: if memory runs out on the way, the next
        collect returns them.
        """
        observer = self.observed.observer
        noted = None if observer is None else observer.before_results(slots)
        try:
            parts = self.results.gather(slots)
            flagged = [part for part in parts if np.count_nonzero(part.flags)]
            judged = self.continuity.judge(slots, flagged)
            batch = self._batch(slots, parts, flagged, judged.is_cut)
            if self._first_observations.left:
                self._first_observations.check(parts)
                self._conditions.note(FIRST_RESULTS, bool(self._first_observations.left))
            flags = [False] * len(slots) if judged.is_cut is None else judged.is_cut.tolist()
            self.parts.watcher.check_interrupt()
            self.stats.account(parts, synchronous=synchronous)
            self.continuity.returned(slots, flagged, judged)
            self.results.let_go(slots)
            self.requests.hand_out(slots)
        except BaseException:
            self.requests.put_back(slots)
            raise
        if self.stats.num_batches >= self.supervisor.hints.due:
            self.give_hints()
        if observer is not None:
            observer.after_results(noted, parts)
        if self._arrivals.held_back:
            self._arrivals.admit(slots, self.intake.now)
        if synchronous and self.newest.keeps:
            self.newest.note_returned(batch)
        return batch, flags

    def give_hints(self) -> None:
        """Log if the measured times suggest other settings."""
        self.supervisor.hints.look(self.stats, self.parts.poller.num_cores)

    def _batch(
        self,
        slots: NDArray[np.intp],
        parts: list[ResultColumns],
        flagged: Sequence[ResultColumns],
        is_cut: NDArray[np.bool_] | None,
    ) -> BatchedData:
        """Make a batch of `parts`, and mark where the step limit cuts an episode."""
        results = self.results
        for part in flagged if is_cut is None else parts:
            if is_cut is not None:
                part.limit_reached = is_cut if part.positions is None else is_cut[part.positions]
                if self.continuity.mark_truncated:
                    part.flags[part.limit_reached, ..., TRUNCATED] = True
            results.add_episodes(part)
        return batch_of_results(parts, self, slots, self.envs.names, results.sources(slots))

    def step(self, batch: BatchedData, now: float) -> Procedure[tuple[BatchedData, Flags | None]]:
        """Send a batch of steps and wait for all of them."""
        with self.observed.call("step", now):
            return (yield from self._step(batch, now))

    def _step(self, batch: BatchedData, now: float) -> Procedure[tuple[BatchedData, Flags | None]]:
        slots = self._slots_of(batch)
        self._dispatch.check_local(slots, "step")
        send = partial(self._send_steps, batch, slots, now)
        ticket, _ = yield from self.waiting.ask(now, slots, send)
        results, flags = self.settled(ticket, slots)
        return results, flags if self.continuity.auto_reset_is_open else None

    def settled(self, ticket: Ticket, slots: NDArray[np.intp]) -> tuple[BatchedData, Flags]:
        """Return the results of a call in its order, or raise its faults with the results."""
        if not ticket.faults:
            return self.hand_out(slots, synchronous=True)
        done = self.requests.ready(ticket.slots)  # Others may have requests of other calls.
        fault = ticket.faults[0]
        fault.others = tuple(ticket.faults[1:])
        if len(done):
            try:
                fault.results = self.hand_out(done, synchronous=True)[0]
            except BaseException:
                for unraised, own in ticket.failures():
                    self.requests.collector.keep(own, unraised)
                raise
            others = "1 other env" if len(done) == 1 else f"{len(done)} other envs"
            fault.add_note(f"the results of {others} of the same call are in the error's `results`")
        raise fault

    def reset(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Reset envs and wait for all of them."""
        with self.observed.call("reset", now):
            return self.settled(*(yield from self._resets.reset(now, seed, options, env_ids)))

    def reset_members(
        self,
        now: float,
        server: Membership,
        seed: int | None,
        options: dict[str, Any] | None,
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Reset all envs that have joined a host and wait for them."""
        with self.observed.call("reset", now):
            replied = yield from self._resets.reset_members(now, server, seed, options)
            return self.settled(*replied)

    def reset_async(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> None:
        """Send resets, whose results `collect` returns."""
        with self.observed.call("reset_async", now):
            self._resets.reset_async(now, seed, options, env_ids)
        self.waiting.wake()

    # -- ends without results ---------------------------------------------------------

    def abort(self, now: float, env_ids: Sequence[str] | None) -> Procedure[None]:
        """End the requests of envs, and drop their results."""
        with self.observed.call("abort", now):
            self.lifetime.check_open()
            slots = self._all_slots if env_ids is None else self.envs.find(env_ids)
            self.intake.now = now
            self.waiting.poll()
            self._aborts.drop(slots)
            yield from self._aborts.end(slots, now)

    @property
    def _all_slots(self) -> NDArray[np.intp]:
        """The slots of local envs, and of members that are present or not."""
        return np.arange(len(self.envs))

    def drain_requests(
        self, now: float, deadline: float | None
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Return the results that are ready by then, and end all other requests."""
        with self.observed.call("drain", now):
            return (yield from self._drain(now, deadline))

    def _drain(self, now: float, deadline: float | None) -> Procedure[tuple[BatchedData, Flags]]:
        self.lifetime.check_open()
        self._check_collecting()
        collector, end = self.requests.collector, now + (deadline or 0.0)
        self.collecting = True
        try:
            self.intake.now = now
            self.waiting.poll()
            while now < end and collector.num_awaited:
                now = yield from self.waiting.turn(collector.num_awaited, end)
                self.waiting.poll()
            yield from self._aborts.end(self._all_slots, now)
        finally:
            self.collecting = False
            self.waiting.end()
        collector.note_faults(self.calls.drop())
        results: tuple[BatchedData, Flags] = BatchedData([], []), []
        if collector.num_ready:
            slots = np.sort(collector.take(collector.num_ready))
            results = self.hand_out(slots, synchronous=False)
        if collector.faults:
            faults = [*collector.faults]
            for fault in faults:
                self._note_raised(fault)
            faults[0].results, faults[0].others = results[0], tuple(faults[1:])
            raise faults[0]
        return results

    # -- states of envs ---------------------------------------------------------------

    def snapshot(self, now: float, env_ids: Sequence[str] | None) -> Procedure[bytes]:
        """Take a snapshot of envs."""
        with self.observed.call("snapshot", now):
            return (yield from self._snapshots.take(now, env_ids))

    def restore(
        self, now: float, data: bytes, env_ids: Sequence[str] | None
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Restore envs, and return their last results as first observations."""
        with self.observed.call("restore", now):
            slots, positions, now = yield from self._snapshots.put_back(now, data, env_ids)
            self.continuity.note_shows(slots.tolist(), positions)
            return self.settled(*(yield from self._resets.show_restored(now, slots)))

    def pending(self) -> list[str]:
        """Return the ids of envs whose result, value or error was not returned yet."""
        self.intake.drain()
        state, owner = self.requests.state, self.requests.owner
        return self.envs.names.ids(np.flatnonzero((state != State.IDLE) & (owner != NOBODY)))


def _answered(batch: BatchedData) -> list[str]:
    """Return the ids of the envs that a batch of the user's own values answers."""
    env_ids = batch.env_ids()
    for id_, env_id in zip(batch.ids(), env_ids, strict=True):
        if env_id != id_ and not env_id.startswith(f"{id_}/"):
            raise BadAction(
                f"under the id {id_!r} there is a response of {env_id!r}; give each under its own "
                "env's id; nothing was sent"
            )
    return env_ids
