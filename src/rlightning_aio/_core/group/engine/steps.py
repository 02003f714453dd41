"""`Steps`: from the actions of a batch to the results of the next one.

In reading order: check a batch, write its actions, send its requests; wait; hand results out.
`Conditions.unusual` says whether anything rare must be looked at. A batch is *ordinary* where it is
0, if the batch answers the group's own results: its actions are written with one copy, and its
requests go into the rings of all workers with one call, or to the one inline host. For any other
batch `actions` checks and writes, and finds the words for what it refuses, and
`Supervisor.hand_over` sends.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeAlias

import msgspec
import numpy as np

from rlightning_aio._core.group.drivers.wait import Procedure, earliest
from rlightning_aio._core.group.engine.actions import (
    number_limits,
    response_columns,
    write_actions,
    write_column,
)
from rlightning_aio._core.group.state.conditions import BESIDE_ROWS, UNLIKE_ENVS
from rlightning_aio._core.group.state.request_states import COLLECTOR
from rlightning_aio._core.hosts.base import Executing
from rlightning_aio.batch.data import BatchedData, answer_of, batch_of_results, slots_of
from rlightning_aio.errors import (
    BadAction,
    EnvBusy,
    NothingPending,
    RLightningError,
    UnknownEnv,
)
from rlightning_aio.protocol import exchange
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.slab import AS_BEFORE, NO_SEED, TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.actions import OutOfBandSteps
    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.protocol.columns import Rows

_STEP: Final = int(Operation.STEP)
Flags: TypeAlias = "list[bool]"
Packed: TypeAlias = "tuple[NDArray[np.intp], list[Any]]"
"""Positions in a batch of steps, and for each the packed arguments that go out of band."""


class CollectRules(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """The checked arguments of `EnvGroup.collect_async`.

    Each collect makes one, so this is a `Struct`: a frozen dataclass takes four times as long.
    """

    timeout: float | None = None
    wait_all: bool = False
    min_results: int = 1
    max_results: int | None = None
    deadline: float | None = None


class Steps:
    """See the module; methods have the names of those of `EnvGroup`.

    Args:
        tables: of the group; batches of results say that they are from these.
        supervisor, results, waiting: of the group.
    """

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        results: Results,
        waiting: Waiting,
    ) -> None:
        self._tables = tables
        self._layout = tables.layout
        self._conditions = tables.conditions
        self._envs = tables.envs
        self._requests = tables.requests
        self._episodes = tables.episodes
        self._observed = tables.observed
        self._lifetime = tables.lifetime
        self._supervisor = supervisor
        self._hint = supervisor.hint
        self._completions = tables.completions
        self._driver = tables.driver
        self._results = results
        self._waiting = waiting
        self._intake = waiting.intake
        self._sums = tables.sums
        # The hosts of all local envs had rings when the group started.
        self._in_rings = self._has_places = False

    def begin(self) -> None:
        """Note what kind of envs were started."""
        envs, slabs, hosts = self._envs, self._layout.slabs, self._supervisor.hosts
        self._has_places = bool(self._supervisor.places.servers)
        # Places are empty as yet; `_asks_a_place` finds requests to them.
        own: set[int] = {*self._requests.hosts[: envs.num_local].tolist()}
        local = [hosts[host_id] for host_id in own]
        is_inline = len(local) == 1 and isinstance(local[0], Executing)
        self._in_rings = all(self._requests.rings[host_id] for host_id in own)
        in_one_slab = len(slabs) == 1 and envs.num_local > 0
        ordinary = (
            in_one_slab
            and (is_inline or self._in_rings)
            and not envs.any_beside_rows
            and bool(slabs[0].action_columns)
        )
        self._conditions.note(UNLIKE_ENVS, not ordinary)
        if ordinary:
            self._all_rows = slice(0, envs.num_local)
            leaf, column = slabs[0].action_columns[0]
            self._action_shape = leaf.shape
            # Of a Dict or Tuple, `write_column` finds the arrays.
            self._limits = {} if leaf.path else number_limits(column.dtype)

    # -- the operations ---------------------------------------------------------------

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps, whose results `collect` returns."""
        try:
            slots, packed = self.write(batch, now)
            self.send(slots, packed, now, None)
        finally:
            if self._observed.observer is not None:
                self._observed.observer.note_call("step_async", now)
        if self._waiting.wanted:  # A waiting collector has not armed the bell for these results.
            self._waiting.wake()

    def step(self, batch: BatchedData, now: float) -> Procedure[tuple[BatchedData, Flags | None]]:
        """Send a batch of steps and wait for all of them."""
        began = now
        try:
            slots, packed = self.write(batch, now)
            send = partial(self.send, slots, packed, now)
            ticket, now = yield from self._waiting.ask(now, slots, send)
            if ticket.errors:
                self._raise_faults(ticket)
            results, flags = self.hand_out(slots)
        finally:
            if self._observed.observer is not None:
                self._observed.observer.note_call("step", began)
        return results, flags if self._episodes.auto_reset_is_open else None

    def collect(self, now: float, rules: CollectRules) -> Procedure[tuple[BatchedData, Flags]]:
        """Wait for results by the rules of `EnvGroup.collect_async`, and return them."""
        began, waiting, collector = now, self._waiting, self._requests.collector
        try:
            if self._waiting.collecting or self._conditions.unusual:
                self.check_collectable()
            limits = None if rules.timeout is rules.deadline is None else _Limits(rules, now)
            self._waiting.collecting = now
            try:
                if now >= self._supervisor.look_by:
                    now = yield from waiting.check_now()
                while True:
                    waiting.poll()
                    ready = collector.num_ready
                    total = ready + collector.num_awaited
                    if collector.faults or not total:
                        self._check_possible(total)
                    most = min(total, rules.max_results or total)
                    need = most if rules.wait_all else min(rules.min_results, most)
                    wanted, until = (need or 1) - ready, None
                    if limits is not None:
                        wanted, until = limits.num_wanted(now, ready, most, need or 1)
                    if wanted <= 0:
                        break
                    now = yield from waiting.turn(wanted, until)
            finally:
                self._waiting.collecting = 0.0
            slots, local = collector.pop_ready(most), self._envs.local
            if len(slots) == len(local) > slots.item(-1):
                slots = local  # The same slots, which lie side by side.
            return self.hand_out(slots)
        finally:
            if self._observed.observer is not None:
                self._observed.observer.note_call("collect_async", began)

    def check_collectable(self) -> None:
        """Raise an error if the group is closed, or another call collects."""
        self._lifetime.check_open()
        if self._waiting.collecting:
            raise RLightningError(
                "another collect_async is already waiting on this group; one collector at a time"
                + self._driver.others(self._requests.collector)
            )

    def _check_possible(self, total: int) -> None:
        """Raise the collector's oldest error, or else if no result can come."""
        fault = next(iter(self._requests.collector.faults), None)
        if fault is not None:
            self._requests.collector.take_fault(fault)
            raise fault
        if not total:
            raise NothingPending(
                "nothing to collect: no request is outstanding; send one with step_async"
            )

    # -- check, write, send -----------------------------------------------------------

    def write(
        self, batch: BatchedData, now: float, *, stops: bool = True
    ) -> tuple[NDArray[np.intp], Packed | None]:
        """Write the actions of a batch into the rows of its envs, all of which are idle.

        Args:
            batch: of responses.
            now: monotonic seconds.
            stops: if an action is wrong, hardware of the batch stops.

        Returns their slots, and what goes out of band.

        Raises:
            RLightningError: something is wrong with the batch or its envs; nothing was sent.
        """
        try:
            if self._completions:
                self._intake.apply_completions()
            answer = None if self._conditions.unusual else answer_of(batch, self._tables)
            if answer is None:
                return self._write_any(batch, now)
            slots, columns = answer
            if not len(slots) or len(self._requests.state[slots].nonzero()[0]):
                return self._write_any(batch, now)
            if self._has_places and self._asks_a_place(slots):
                return self._write_any(batch, now)
            slab = self._layout.slabs[0]
            rows: Rows = self._all_rows if slots is self._envs.local else slots
            action = columns["action"]
            fits = type(action) is np.ndarray and action.shape == (len(slots), *self._action_shape)
            limit = self._limits.get(action.dtype, -1.0) if fits else -1.0
            is_small = limit is not None and limit > 0 and action.size <= exchange.FEW_NUMBERS
            if limit is None or (is_small and exchange.sum_of_squares(action) <= limit):
                slab.action_columns[0][1][rows] = action
            else:
                write_column(action, slab, slots, rows, self._envs)
            self._results.note_sent(slots, columns)
            return slots, None
        except (BadAction, UnknownEnv, EnvBusy) as error:
            if stops and isinstance(batch, BatchedData):  # pyright: ignore[reportUnnecessaryIsInstance]
                self._stop_hardware(batch.ids(), error)
            raise

    def _stop_hardware(self, ids: Sequence[str], error: RLightningError) -> None:
        """Stop the hardware of a batch that was refused, unless only because an env is busy."""
        known = set(ids)
        if isinstance(error, EnvBusy) and len(known) == len(ids):
            return
        for env_id in known:
            with suppress(UnknownEnv):
                self._tables.stop_hardware([self._envs.find_one(env_id)])

    def _write_any(self, batch: BatchedData, now: float) -> tuple[NDArray[np.intp], Packed | None]:
        """Do the same for any batch."""
        slots = self._slots_of(batch)
        self._waiting.check_sendable(now, slots, "step")
        self._supervisor.places.check_step(slots)
        self._supervisor.losses.check_step(slots)
        if not len(slots):
            return slots, None
        out_of_band = write_actions(batch, slots, self._envs, self._layout)
        packed = None if out_of_band is None else self._packed(slots, out_of_band)
        self._results.note_sent(slots, response_columns(batch, slots, self._layout))
        return slots, packed

    def _packed(self, slots: NDArray[np.intp], out_of_band: OutOfBandSteps) -> Packed:
        """Pack the arguments of steps that go out of band."""
        chosen = slots[out_of_band.positions].tolist()
        try:
            for slot, (action, extras) in zip(chosen, out_of_band.contents, strict=True):
                place = self._tables.record_of(slot).place
                if place is not None:
                    place.check_step(action, extras)
            return out_of_band.positions, [
                self._supervisor.packed(slot, content, "the response")
                for slot, content in zip(chosen, out_of_band.contents, strict=True)
            ]
        except TypeError as error:
            raise BadAction(str(error)) from error

    def _slots_of(self, batch: BatchedData) -> NDArray[np.intp]:
        """Return the slots of a batch's envs; a batch that answers our results knows them."""
        if not isinstance(batch, BatchedData):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise BadAction(
                f"a step takes a batch of responses, not a {type(batch).__name__}: answer the last "
                "results with batch.respond(action=...); nothing was sent"
            )
        slots = slots_of(batch, self._tables)
        return self._envs.chosen(_answered(batch)) if slots is None else slots

    def send(
        self, slots: NDArray[np.intp], packed: Packed | None, now: float, ticket: Ticket | None
    ) -> None:
        """Number the requests of a batch that is written, and give them to their hosts."""
        requests = self._requests
        owner = COLLECTOR if ticket is None else ticket.owner
        is_ordinary = self._in_rings and len(slots) > 0 and not self._conditions.unusual
        if is_ordinary and not (self._has_places and self._asks_a_place(slots)):
            for ring in requests.publish(slots, self._episodes.due[slots], owner, now):
                ring.wake()
            return
        resets = self._episodes.due[slots]
        if self._episodes.exceptional:
            reports = self._episodes.report_losses(slots)
            # A place remembers its last reset itself, and may have no row yet. An episode that had
            # ended is not begun again, nor with the seed of a reset that has failed since.
            local = reports & (slots < self._envs.num_local)
            seeds = np.where(resets[local], NO_SEED, AS_BEFORE)
            self._layout.write_seeds(slots[local], seeds)
            resets = resets | reports
        entries = requests.issue(slots, _STEP, owner, now)
        if b"\1" in resets.tobytes():
            requests.numbering.into_resets(slots, entries, resets)
        if packed is None:
            self._supervisor.hand_over(slots, entries)
        else:
            self._hand_over(slots, entries, packed, resets)

    def _hand_over(
        self,
        slots: NDArray[np.intp],
        entries: NDArray[np.int64],
        packed: Packed,
        resets: NDArray[np.bool_],
    ) -> None:
        """Give issued steps to their hosts; without their arguments where they became resets."""
        positions, arguments = packed
        out_of_band = np.zeros(len(slots), np.bool_)
        out_of_band[positions] = True
        out_of_band &= ~resets
        self._supervisor.hand_over(slots[~out_of_band], entries[~out_of_band])
        kept = out_of_band[positions]
        chosen = positions[kept]
        arguments = [one for one, keep in zip(arguments, kept.tolist(), strict=True) if keep]
        self._supervisor.hand_over(slots[chosen], entries[chosen], arguments)

    def _asks_a_place(self, slots: NDArray[np.intp]) -> bool:
        """Return True if any of `slots` belongs to a client, or will."""
        return int(slots.max()) >= self._envs.num_local

    # -- hand out ---------------------------------------------------------------------

    def settled(self, ticket: Ticket, slots: NDArray[np.intp]) -> tuple[BatchedData, Flags]:
        """Return the results of a call in its order, or raise its faults with the results."""
        if ticket.errors:
            self._raise_faults(ticket)
        return self.hand_out(slots)

    def _raise_faults(self, ticket: Ticket) -> NoReturn:
        done = self._requests.ready(ticket.slots)  # Others may have requests of other calls.
        fault = ticket.faults[0]
        fault.others = tuple(ticket.faults[1:])
        if len(done):
            fault.results = self.hand_out(done)[0]
            others = "1 other env" if len(done) == 1 else f"{len(done)} other envs"
            fault.add_note(f"the results of {others} of the same call are in the error's `results`")
        raise fault

    def hand_out(self, slots: NDArray[np.intp]) -> tuple[BatchedData, Flags]:
        """Return the results of `slots`, all ready."""
        results, observer = self._results, self._observed.observer
        try:
            parts = results.gather(slots)
            flagged: list[ResultColumns] = []
            for part in parts:  # A comprehension is a call more.
                if b"\1" in part.flags.tobytes():
                    flagged.append(part)  # noqa: PERF401
            is_cut = self._episodes.returned(slots, flagged)
            for part in flagged if is_cut is None else parts:
                if is_cut is not None:
                    self._mark_cut(part, is_cut)
                results.add_episodes(part)
            batch = batch_of_results(
                parts, self._tables, slots, self._envs.names, results.sources(slots)
            )
            self._sums.add(parts)
        finally:
            if self._conditions.unusual & BESIDE_ROWS:
                results.drop(slots)
            self._requests.hand_out(slots)
        if observer is not None:
            observer.note_results(parts)
        if self._sums.num_batches >= self._hint.due:
            self._hint.look()
        return batch, [False] * len(slots) if is_cut is None else is_cut.tolist()

    def nothing(self) -> tuple[BatchedData, Flags]:
        """Return a batch of no results."""
        slots = self._envs.all[:0]
        sources = self._results.sources(slots)
        return batch_of_results((), self._tables, slots, self._envs.names, sources), []

    @staticmethod
    def _mark_cut(part: ResultColumns, is_cut: NDArray[np.bool_]) -> None:
        """Mark where the step limit cuts an episode."""
        part.limit_reached = is_cut if part.positions is None else is_cut[part.positions]
        part.flags[part.limit_reached, ..., TRUNCATED] = True


class _Limits:
    """The time limits of a collect.

    Args:
        rules: of the collect.
        now: when it began.
    """

    def __init__(self, rules: CollectRules, now: float) -> None:
        self._timeout = rules.timeout
        self._deadline = rules.deadline
        self._end = None if rules.deadline is None else now + rules.deadline
        self._window: float | None = None

    def num_wanted(self, now: float, ready: int, most: int, need: int) -> tuple[int, float | None]:
        """Return for how many more results to wait, and until when; 0 if there are enough.

        With a timeout, the first result opens a window in which further ones may come.

        Args:
            now: monotonic seconds.
            ready: number of results that are ready.
            most: that can be.
            need: that are needed.
        """
        if ready and self._timeout is not None and self._window is None:
            self._window = now + self._timeout
        is_open = self._window is not None and now < self._window and ready < most
        if ready >= need and not is_open:
            return 0, None
        if self._end is not None and now >= self._end:
            raise TimeoutError(
                f"{ready} of the {need} results needed came within {self._deadline} s; nothing is "
                "lost, the next collect_async gets them"
            )
        if is_open:
            return most - ready if ready else 1, earliest(self._end, self._window)
        return 1 if self._timeout is not None else need - ready, self._end


def _answered(batch: BatchedData) -> list[str]:
    """Return the ids of the envs that a batch of the user's own values answers."""
    env_ids = batch.env_ids()
    for id_, env_id in zip(batch.ids(), env_ids, strict=True):
        if env_id != id_:
            raise BadAction(
                f"under the id {id_!r} there is a response of {env_id!r}; give each under its own "
                "env's id, or to that env's handle; nothing was sent"
            )
    return env_ids
