"""The core: decides what every request, reply and failure means, and never waits.

It holds the table of requests, the supervisor of hosts and the poller, none of which calls
it back, and says what follows from what. Its procedures are generators: where one
can't go on, it yields a `Wait`; the driver blocks until a source has told something or the
time has come, has what was told taken in (`drain`), and sends the time back in.
Rule: no I/O beyond handing bytes to hosts, no clock, no event loop. Everything that is
asynchronous and everything that is synchronous runs through this one implementation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rlightning_aio.batch.data import (
    BatchedData,
    Origin,
    batch_of_results,
    columns_of_responses,
    names_of,
    slots_of,
)
from rlightning_aio.batch.sent import columns_of_values
from rlightning_aio.errors import (
    BadAction,
    NothingPending,
    RLightningError,
)
from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS, AutoReset
from rlightning_aio.group.calls import Calls
from rlightning_aio.group.dispatch import Dispatch
from rlightning_aio.group.first_looks import FirstLooks
from rlightning_aio.group.hint import HINT_AFTER_BATCHES
from rlightning_aio.group.intake import Intake
from rlightning_aio.group.recovery import Recovery
from rlightning_aio.group.requests import COLLECTOR
from rlightning_aio.group.results import Results
from rlightning_aio.group.seeds import checked_seed, seeds_for
from rlightning_aio.group.states import States
from rlightning_aio.group.stats import Stats
from rlightning_aio.group.wait import Procedure, Wait, earliest
from rlightning_aio.group.waiting import Waiting
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.slab import AS_RESTORED, TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.poller import Poller
    from rlightning_aio.group.requests import Requests, Ticket
    from rlightning_aio.group.resumption import Resumption
    from rlightning_aio.group.seeds import Seeds
    from rlightning_aio.group.slab_layout import SlabLayout
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.hosts.base import Host, Membership, Watcher
    from rlightning_aio.hosts.messages import Completions
    from rlightning_aio.types import EnvMeta

__all__ = ["Core", "Flags"]

Flags: TypeAlias = "list[bool]"


class Core:
    """What an `EnvGroup` can be asked to do.

    Args:
        envs, requests, layout, resumption: the group's tables.
        supervisor, poller: of its hosts.
        completions: where these tell what has become of requests.
        watcher: the driver.
        zero_copy: observations are handed out as views where their rows are contiguous.
    """

    # The dict is for what a timeline covers its methods with. Attributes that were in it too would
    # take longer to read from then on.
    __slots__ = (
        "__dict__",
        "__weakref__",
        "_collecting",
        "_dispatch",
        "_first_looks",
        "_handed_out",
        "_intake",
        "_layout",
        "_recovery",
        "_results",
        "_resumption",
        "_states",
        "_waiting",
        "auto",
        "calls",
        "drain",
        "envs",
        "requests",
        "stats",
        "supervisor",
    )

    def __init__(
        self,
        envs: EnvTable,
        requests: Requests,
        layout: SlabLayout,
        resumption: Resumption,
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
        self.auto = AutoReset(envs, requests)
        self.stats = Stats(envs, requests)
        self._layout = layout
        self._results = Results(envs, layout, zero_copy=zero_copy)
        self._first_looks = FirstLooks(envs)
        self._recovery = Recovery()
        self._resumption = resumption
        self._dispatch = Dispatch(envs, requests, supervisor)
        self._intake = Intake(
            completions,
            envs,
            requests,
            layout,
            supervisor,
            self._dispatch,
            self._results,
            self._recovery,
            resumption,
            self.auto,
            self.stats,
        )
        # Takes in what hosts have told; a driver calls it before a procedure goes on.
        self.drain = self._intake.drain
        self._waiting = Waiting(requests, supervisor, poller, self._intake, watcher)
        self.calls = Calls(
            envs,
            requests,
            supervisor,
            self._dispatch,
            self._intake,
            self.auto,
            resumption,
            self._waiting,
        )
        self._states = States(
            envs,
            supervisor,
            self._dispatch,
            self.calls,
            self.auto,
            self._recovery,
            resumption,
            self._waiting,
        )
        self._collecting = False
        self._handed_out = 0

    # -- life -------------------------------------------------------------------------

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """See `EnvGroup.init`."""
        for host in self.supervisor.hosts:
            self._results.begin_schemas(range(host.first_slot, host.first_slot + host.num_envs))
        return self.supervisor.start(now)

    def close(self, now: float) -> Procedure[None]:
        """See `EnvGroup.close`."""
        return self.supervisor.close(now)

    def describe_workers(self, now_ns: int) -> list[dict[str, Any]]:
        """See `EnvGroup.get_workers`."""
        if self.supervisor.open:
            self._waiting.poll()  # Results that lie there are owed no more.
        return self.supervisor.describe(now_ns)

    # -- requests ---------------------------------------------------------------------

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps that `collect` will answer."""
        self._send_steps(batch, self._slots_of(batch), None, now)
        # The collector has not asked these envs' workers to wake it.
        self._waiting.wake()

    def _slots_of(self, batch: BatchedData) -> NDArray[np.intp]:
        """Slots of a batch's envs; free for a batch that answers one of ours."""
        if not isinstance(batch, BatchedData):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise BadAction(
                f"a step takes a batch of responses, not a {type(batch).__name__}: answer the last "
                "results with batch.respond(action=...); nothing was sent"
            )
        slots = slots_of(batch, self)
        return self._dispatch.distinct(_answered(batch)) if slots is None else slots

    def _send_steps(
        self, batch: BatchedData, slots: NDArray[np.intp], ticket: Ticket | None, now: float
    ) -> None:
        self._intake.now = now
        self._intake.drain()
        if self.supervisor.has_members:
            batch, slots = self._without_gone(batch, slots)
            if not len(slots):
                return
        self._dispatch.check_sendable(slots, "step")
        out_of_band = write_actions(batch, slots, self.envs, self._layout)
        packed = [] if out_of_band is None else self._dispatch.packed_steps(slots, out_of_band)
        self._results.note_sent(slots, _columns(batch))
        resets = self.auto.due(slots)
        if self._recovery.any_untold:
            telling = self._recovery.tell(slots)
            self._show_standings(slots[telling], ~np.broadcast_to(resets, len(slots))[telling])
            resets = resets | telling
            self.supervisor.note_recovery(any_telling=self._recovery.any_telling)
        entries = self.requests.submit(slots, Operation.STEP, _owner(ticket), now)
        if resets is not NO_RESETS and np.count_nonzero(resets):
            self.requests.into_resets(slots, entries, resets)
        else:
            resets = None
        if out_of_band is None:
            self._dispatch.hand_over(slots, entries)
        else:
            self._dispatch.hand_over_out_of_band(
                slots, entries, out_of_band.positions, packed, resets
            )
        if self.supervisor.has_members:
            self._intake.drain()  # What was withdrawn at once.

    def _show_standings(self, slots: NDArray[np.intp], stepped: NDArray[np.bool_]) -> None:
        """Have envs of replaced workers show where they stand, if they would be `stepped`."""
        seeds, lost = self._resumption.seeds(slots, stepped)
        self._layout.write_seeds(slots, seeds)
        for slot, num_steps in lost.items():
            self.auto.rewind(slot, num_steps, owes=False)

    def _without_gone(
        self, batch: BatchedData, slots: NDArray[np.intp]
    ) -> tuple[BatchedData, NDArray[np.intp]]:
        """`batch` without the clients that have gone since it was handed out, and are back or
        have left their slots to others.

        What they would be asked was meant for the episode that they have lost. Of one that is
        back, the first result of the new episode, which waits to be collected, is the answer.
        """
        names, is_current = self.envs.names, names_of(batch) is self.envs.names
        if is_current and not self.requests.num_ready:
            return batch, slots
        gone = self.requests.joined(slots)
        if not is_current:
            pairs = zip(batch.env_ids(), names.ids(slots), strict=True)
            gone |= np.array([then != now for then, now in pairs], np.bool_)
        if not gone.any():
            return batch, slots
        kept = np.flatnonzero(~gone).tolist()
        env_ids, values = batch.env_ids(), batch.values()
        return BatchedData([env_ids[k] for k in kept], [values[k] for k in kept]), slots[kept]

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
            now = yield from self._waiting.check_liveness(now)
            while True:
                self._waiting.poll()
                if self.requests.faults:
                    self._raise_fault(among)
                ready, total = self.requests.pending(among)
                if not total and not self.supervisor.has_members:
                    whose = "" if entries is None else f" of entries {', '.join(entries)}"
                    raise NothingPending(
                        f"nothing to collect: no request{whose} is outstanding; send one with "
                        "step_async"
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
                now = yield from self._waiting.turn(wanted, until)
        finally:
            self._collecting = False
            self._waiting.end()
        slots = self.requests.take(most, among)
        return self.hand_out(np.sort(slots) if ordered else slots, synchronous=False)

    def _raise_fault(self, among: NDArray[np.bool_] | None) -> None:
        """Raise the oldest error for the collector, if there is one of these slots."""
        for fault in self.requests.faults:
            if among is None or among[self.envs.find_one(fault.env_id)]:
                self.requests.faults.remove(fault)
                raise fault

    def hand_out(self, slots: NDArray[np.intp], *, synchronous: bool) -> tuple[BatchedData, Flags]:
        """The results of `slots`, all ready. They stay so until the batch is complete: where
        memory runs out on the way, the next collect hands them out.
        """
        try:
            batch, limits, parts = self._batch(slots)
            if self._first_looks.left:
                self._first_looks.look(parts)
            flags = [False] * len(slots) if limits is None else limits.tolist()
            self.stats.account(parts, synchronous=synchronous)
            self._results.let_go(slots)
            self.requests.hand_out(slots)
        except BaseException:
            self.requests.put_back(slots)
            raise
        self._handed_out += 1
        if self._handed_out == HINT_AFTER_BATCHES:
            self.supervisor.give_hint(self.stats.summary()["latency_us"])
        if self._intake.held_back:
            self._intake.admit(slots)
        return batch, flags

    def _batch(
        self, slots: NDArray[np.intp]
    ) -> tuple[BatchedData, NDArray[np.bool_] | None, list[ResultColumns]]:
        """A batch, where the step limit was reached, and its parts. Doing it twice is harmless."""
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
        origin = Origin(self, slots, self.envs.names)
        return batch_of_results(parts, origin, results.sources(slots)), limits, parts

    def step(self, batch: BatchedData, now: float) -> Procedure[tuple[BatchedData, Flags | None]]:
        """See `EnvGroup.step`."""
        slots = self._slots_of(batch)
        self._dispatch.check_local(slots, "step")
        ticket = self.requests.open_ticket(slots)
        try:
            self._send_steps(batch, slots, ticket, now)
        except BaseException:
            self.requests.drop(ticket)
            raise
        yield from self._waiting.until_replied(ticket)
        results, flags = self._settled(ticket, slots)
        return results, flags if self.auto.active else None

    def _settled(self, ticket: Ticket, slots: NDArray[np.intp]) -> tuple[BatchedData, Flags]:
        """The results of a call, in its order; its faults, with the results, as an error."""
        if not ticket.faults:
            return self.hand_out(slots, synchronous=True)
        done = self.requests.ready(slots)
        fault = ticket.faults[0]
        fault.others = tuple(ticket.faults[1:])
        if len(done):
            try:
                fault.results = self.hand_out(done, synchronous=True)[0]
            except BaseException:
                self.requests.faults.extend(ticket.faults)
                raise
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
        slots = self._everyone() if env_ids is None else self._dispatch.distinct(env_ids)
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
            seeds = (checked_seed(seed) + offsets - offsets[:1]).tolist()
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
            self._waiting.check(now)
        return now

    def reset_async(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> None:
        """Send resets that `collect` will answer."""
        slots = self._everyone() if env_ids is None else self._dispatch.distinct(env_ids)
        seeds = self._seeds_for(slots, seed, now)
        self._dispatch.check_sendable(slots, "reset")
        packed = self._packed_resets(slots, seeds, options)
        self._forget_losses(slots)
        self._submit_resets(slots, seeds, packed, COLLECTOR, now)
        self._waiting.wake()

    def _forget_losses(self, slots: NDArray[np.intp]) -> None:
        """Whoever resets begins a new episode anyway, and needn't be told of the one before."""
        self._recovery.forget(slots.tolist())
        if self._recovery.any_telling:
            self.supervisor.note_recovery(any_telling=True)

    def _reset(
        self, now: float, seed: Seeds, options: dict[str, Any] | None, slots: NDArray[np.intp]
    ) -> Procedure[tuple[BatchedData, Flags]]:
        seeds = self._seeds_for(slots, seed, now)
        joined = self.requests.joined(slots)
        self._dispatch.check_sendable(slots[~joined], "reset")
        packed = self._packed_resets(slots, seeds, options)
        self._forget_losses(slots)
        ticket = self.requests.open_ticket(slots)
        asked = slots
        if joined.any():
            enough = seed is None and options is None
            self._take_first_results(slots[joined], ticket, enough=enough)
            if enough:
                asked, seeds = slots[~joined], seeds[~joined]
        self._submit_resets(asked, seeds, packed, ticket.owner, now)
        yield from self._waiting.until_replied(ticket)
        return self._settled(ticket, slots)

    def _seeds_for(self, slots: NDArray[np.intp], seed: Seeds, now: float) -> NDArray[np.int64]:
        """The seeds of resets that are about to be sent to `slots`, as things are now."""
        self._intake.now = now
        self._intake.drain()
        if self.supervisor.has_members:
            self.supervisor.rank_members()
        return seeds_for(self.envs, seed, slots)

    def _packed_resets(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any] | None
    ) -> list[Any] | None:
        return None if options is None else self._dispatch.packed_resets(slots, seeds, options)

    def _submit_resets(
        self,
        slots: NDArray[np.intp],
        seeds: NDArray[np.int64],
        packed: list[Any] | None,
        owner: int,
        now: float,
    ) -> None:
        entries = self.requests.submit(slots, Operation.RESET, owner, now)
        self._results.note_sent(slots, None)
        if packed is None:
            self._layout.write_seeds(slots, seeds)
        self._dispatch.hand_over(slots, entries, packed)

    def _take_first_results(self, slots: NDArray[np.intp], ticket: Ticket, *, enough: bool) -> None:
        """Let a reset have the first results of clients that have only just joined.

        Joining was a reset; unless this one asks for more than that, it was `enough`: an env
        that takes minutes to reset, as a robot may, isn't reset twice.
        """
        self.requests.take_joined(slots, ticket if enough else None)
        if not enough:
            for slot in slots.tolist():
                self._results.drop(slot)

    # -- states of envs ---------------------------------------------------------------

    def snapshot(self, now: float, env_ids: Sequence[str] | None) -> Procedure[bytes]:
        """See `EnvGroup.snapshot`."""
        return self._states.snapshot(now, env_ids)

    def restore(
        self, now: float, data: bytes, env_ids: Sequence[str] | None
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """See `EnvGroup.restore`."""
        slots = yield from self._states.put_back(now, data, env_ids)
        self._forget_losses(slots)
        ticket = self.requests.open_ticket(slots)
        self._submit_resets(slots, np.full(len(slots), AS_RESTORED), None, ticket.owner, now)
        yield from self._waiting.until_replied(ticket)
        return self._settled(ticket, slots)

    def pending(self) -> int:
        """Requests that `collect_async` has still to answer, ready or not."""
        self._intake.drain()
        return self.requests.pending()[1]


def _owner(ticket: Ticket | None) -> int:
    return COLLECTOR if ticket is None else ticket.owner


def _answered(batch: BatchedData) -> list[str]:
    """The envs that a batch of somebody's own making answers."""
    env_ids = batch.env_ids()
    for id_, env_id in zip(batch.ids(), env_ids, strict=True):
        if env_id != id_ and not env_id.startswith(f"{id_}/"):
            raise BadAction(
                f"under the id {id_!r} there is a response of {env_id!r}; give each under its own "
                "env's id; nothing was sent"
            )
    return env_ids


def _columns(batch: BatchedData) -> Mapping[str, Any]:
    """What a batch of responses attaches, as columns."""
    columns = columns_of_responses(batch)
    return columns_of_values(batch.values()) if columns is None else columns
