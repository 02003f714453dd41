"""`Steps`: the ordinary step, from the actions of a batch to the results of the next one.

Ordinary is a batch that answers the group's own results and goes to envs in worker processes, or
to envs of one inline host. Everything else takes the general path (`core`), which is correct for
all cases. One attribute tells them apart: `Conditions.unusual`. It is asked at the start of each of
the three parts (send, wait, hand out), so a death or an error in the middle of a step has the rest
of it take the general path.
In reading order: validate, write actions, number and publish; wait; verify, gather.
Absent on purpose: errors of the user's. What is refused is refused by the general path.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

import numpy as np

from rlightning_aio._core.group.drivers.wait import ANY, TURN, Procedure
from rlightning_aio._core.group.engine.actions import number_limits, write_column
from rlightning_aio._core.group.state.conditions import UNLIKE_ENVS
from rlightning_aio._core.group.supervision.supervisor import LOOK_SECONDS
from rlightning_aio._core.hosts.messages import ErrorText
from rlightning_aio.batch.data import BatchedData, answer_of, batch_of_results
from rlightning_aio.protocol import exchange, kernel
from rlightning_aio.protocol.entries import Operation, slot_of
from rlightning_aio.protocol.slab import TRUNCATED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import CollectRules
    from rlightning_aio._core.group.engine.core import Core
    from rlightning_aio._core.hosts.messages import OutOfBand
    from rlightning_aio.protocol.columns import Rows
    from rlightning_aio.types import EnvMeta

__all__ = ["Steps", "StepsAtOnce"]

_STEP: Final = int(Operation.STEP)
_IDLE: Final = 0
"""The state of `Requests` as its array holds it."""


@runtime_checkable
class StepsAtOnce(Protocol):
    """A host that executes steps in the calls of the group."""

    def step_now(self) -> OutOfBand | None:
        """Step the first env, without a request, with the action in the row; what of the result is
        out of band.
        """
        ...

    def submit(self, entries: NDArray[np.int64]) -> None:
        """Accept steps and resets; see `hosts.base.Host`."""
        ...

    def step_next(self) -> tuple[int, OutOfBand | None] | None:
        """Execute the next step or reset: its entry, and what of the result is out of band.

        None if the next request is none of these or there is none, or after an error, which is in
        the queue of completions.
        """
        ...


class Steps:
    """See the module.

    Args:
        core: the general path.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        parts, tables = core.parts, core.parts.tables
        self._layout = tables.layout
        self._conditions = tables.conditions
        self._envs = tables.envs
        self._requests = tables.requests
        self._supervisor = parts.supervisor
        self._poller = parts.poller
        self._bell = parts.bell
        self._rings = parts.rings
        self._completions = parts.completions
        self._watcher = parts.watcher
        self._results = core.results
        self._continuity = tables.continuity
        self._stats = core.stats
        self._hints = parts.supervisor.hints
        self._intake = core.intake
        self._waiting = core.waiting
        self._fence = exchange.new_fence()
        # The inline host of all envs; also the one of the only env, if the group is synchronous.
        self._inline: StepsAtOnce | None = None
        self._alone: StepsAtOnce | None = None

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """Start the hosts, and find out whether steps of their envs can be ordinary."""
        metas = yield from self._core.start(now)
        self._begin()
        return metas

    def _begin(self) -> None:
        envs, slabs, hosts = self._envs, self._layout.slabs, self._supervisor.hosts
        if len(hosts) == 1 and isinstance(hosts[0], StepsAtOnce):
            self._inline = hosts[0]
            if len(envs) == 1 and not self._core.shares_thread:
                self._alone = hosts[0]
        in_rings = None not in self._rings
        in_one_slab = len(slabs) == 1 and len(envs) == len(envs.all) > 0
        ordinary = (
            in_one_slab
            and (in_rings or self._inline is not None)
            and not envs.any_out_of_band
            and bool(slabs[0].action_columns)
        )
        self._conditions.note(UNLIKE_ENVS, not ordinary)
        if ordinary:
            self._all_rows = slice(0, len(envs.all))
            leaf, column = slabs[0].action_columns[0]
            self._action_shape = leaf.shape
            # Of a Dict or Tuple, `write_column` finds the arrays.
            self._limits = {} if leaf.path else number_limits(column.dtype)

    # -- the operations ---------------------------------------------------------------

    def step_async(self, batch: BatchedData, now: float) -> None:
        """Send a batch of steps."""
        slots = None if self._conditions.unusual else self._written(batch)
        if slots is None:
            self._core.step_async(batch, now)
            return
        self._requests.collector.num_awaited += len(slots)
        self._publish(slots, now)
        if self._waiting.wanted:
            self._watcher.wake()  # They have not asked these envs' workers to wake them.

    def step(
        self, batch: BatchedData, now: float
    ) -> Procedure[tuple[BatchedData, list[bool] | None]]:
        """Send a batch of steps and wait for all of them."""
        slots = None if self._conditions.unusual else self._written(batch)
        if slots is None:
            return (yield from self._core.step(batch, now))
        if self._alone is not None and not self._continuity.due[0]:
            self._step_at_once(self._alone, now)
            results, flags = self._hand_out(slots, synchronous=True)
            return results, flags if self._continuity.auto_reset_is_open else None
        requests = self._requests
        ticket = requests.tickets.open(slots)
        try:
            requests.owner[slots] = ticket.owner
            self._publish(slots, now)
            while ticket.remaining > 0 and not self._conditions.unusual:
                yield from self._turn(ticket.remaining)
                self._complete()
            if ticket.remaining > 0:
                yield from self._waiting.until_replied(ticket, now)
        except BaseException:
            self._waiting.give_up(ticket)
            raise
        finally:
            if not self._waiting.wanted:
                self._bell.disarm()
        requests.settle(ticket)
        if ticket.failed:
            results, flags = self._core.settled(ticket, slots)
        else:
            results, flags = self._hand_out(slots, synchronous=True)
        return results, flags if self._continuity.auto_reset_is_open else None

    def collect(self, now: float, rules: CollectRules) -> Procedure[tuple[BatchedData, list[bool]]]:
        """Wait for results by `rules`, and return them."""
        core, requests = self._core, self._requests
        most = 0
        if (
            rules.timeout is rules.deadline is rules.entries is None
            and not core.collecting
            and now < self._supervisor.look_by
        ):
            core.collecting = True
            try:
                while not self._conditions.unusual:
                    self._complete()
                    ready = requests.collector.num_ready
                    total = ready + requests.collector.num_awaited
                    most = total if rules.max_results is None else min(total, rules.max_results)
                    need = most if rules.wait_all else min(rules.min_results, most)
                    if ready >= need:
                        break
                    yield from self._turn(need - ready)
            finally:
                core.collecting = False
                if not self._waiting.wanted:
                    self._bell.disarm()
        if self._conditions.unusual or not most:
            return (yield from core.collect(now, rules))
        slots = requests.collector.take(most)
        if rules.ordered:
            slots = slots.copy()
            slots.sort()
            if len(slots) == len(self._envs.all):
                slots = self._envs.all
        return self._hand_out(slots, synchronous=False)

    # -- validate, write actions, number, publish -------------------------------------

    def _written(self, batch: BatchedData) -> NDArray[np.intp] | None:
        """Slots of an ordinary batch, all idle, whose actions lie in their rows.

        None for any other batch: nothing has happened then, but that rows of idle envs may have
        been written.

        Raises:
            BadAction: the actions don't fit; nothing was sent.
        """
        if self._completions:
            self._intake.drain()
        answer = answer_of(batch, self._core)
        if answer is None or self._conditions.unusual:
            return None
        slots, columns = answer
        if len(self._requests.state[slots].nonzero()[0]) or not len(slots):
            return None
        slab = self._layout.slabs[0]
        rows: Rows = self._all_rows if slots is self._envs.all else slots
        action = columns["action"]
        fits = type(action) is np.ndarray and action.shape == (len(slots), *self._action_shape)
        limit = self._limits.get(action.dtype, -1.0) if fits else -1.0
        is_small = limit is not None and limit > 0 and action.size <= exchange.FEW_NUMBERS
        if limit is None or (is_small and exchange.sum_of_squares(action) <= limit):
            slab.action_columns[0][1][rows] = action
        else:
            write_column(action, slab, slots, rows, self._envs)
        self._results.note_sent(slots, columns)
        return slots

    def _publish(self, slots: NDArray[np.intp], now: float) -> None:
        """Number the requests and give them to their workers."""
        requests = self._requests
        if self._inline is not None:
            self._publish_inline(self._inline, slots, now)
            return
        asleep = kernel.submit(
            slots,
            self._continuity.due[slots],
            int(now * 1e9),
            requests.numbering.entry,
            requests.state,
            requests.sent_ns,
            requests.hosts,
            requests.in_flight,
            self._rings,
            self._fence,
        )
        for ring in asleep:
            ring.wake()

    def _publish_inline(self, host: StepsAtOnce, slots: NDArray[np.intp], now: float) -> None:
        """Number the requests and give them to the host of all envs."""
        requests, resets = self._requests, self._continuity.due[slots]
        entries = requests.numbering.renew(slots, _STEP)
        if np.count_nonzero(resets):
            requests.numbering.into_resets(slots, entries, resets)
        requests.state[slots] = exchange.BUSY
        requests.sent_ns[slots] = int(now * 1e9)
        requests.in_flight[0] += len(slots)
        host.submit(entries)

    def _step_at_once(self, host: StepsAtOnce, now: float) -> None:
        """Step the only env here and now: there is nobody to wait for."""
        self._requests.number_step_at_once(0, now)
        try:
            out_of_band = host.step_now()
        except BaseException as error:
            fault = self._intake.raised(0, ErrorText.of(error))
            if isinstance(error, KeyboardInterrupt):  # The step has ended, too: see `InlineHost`.
                self._requests.collector.keep(self._requests.alone(0), fault)
                raise
            raise fault from None
        if out_of_band:
            self._results.keep_at_once(0, out_of_band)
        self._requests.answer_at_once(0)
        if self._completions:
            self._intake.drain()  # An info has come in a new form.

    def _step_next(self, host: StepsAtOnce) -> bool:
        """Execute the next request here; True if there was one, and it raised no error."""
        found = host.step_next()
        if found is None:
            return False
        entry, out_of_band = found
        if out_of_band:
            self._results.keep_at_once(slot_of(entry), out_of_band)
        self._requests.complete_one(0, entry)
        self._requests.has_news = False
        if len(self._waiting.wanted) > 0:
            self._watcher.wake()  # Another call may have what it waits for.
        return True

    # -- wait -------------------------------------------------------------------------

    def _turn(self, wanted: int) -> Procedure[None]:
        """One turn of waiting for `wanted` more results; see `Waiting.turn`."""
        if self._inline is not None and (self._step_next(self._inline) or self._completions):
            yield TURN
            if self._completions:
                self._intake.drain()  # An error, with which an ordinary step ends.
            return
        waiting, supervisor, in_flight = self._waiting, self._supervisor, self._requests.in_flight
        at_work = len(in_flight) - in_flight.count(0)
        if (
            at_work < self._poller.num_cores
            or supervisor.detector.timed
            or not at_work
            or self._inline is not None  # It rings no bell; what is next there is a call.
        ):
            yield from waiting.turn(wanted, None)
            return
        all_wanted = waiting.wanted
        all_wanted.append(wanted)
        try:
            first = wanted if len(all_wanted) == 1 else min(all_wanted)
            total = sum(in_flight)
            bell = self._bell
            goal = bell.read[-1] + min(first, total)
            if bell.arm(goal, at_last=first >= total):
                now = yield TURN
            else:
                now = yield ANY
                supervisor.look_by = now + LOOK_SECONDS
        finally:
            all_wanted.remove(wanted)
        if self._conditions.unusual or now >= supervisor.look_by:
            waiting.check(now)

    # -- verify, gather ---------------------------------------------------------------

    def _complete(self) -> None:
        """Have requests end whose results lie in their rows."""
        if self._completions:
            self._intake.drain()
        bell, requests = self._bell, self._requests
        if bell.counters == bell.read_by_worker:
            return
        slots = None
        if not self._conditions.unusual:
            slots = kernel.complete(
                bell.counters,
                bell.read,
                requests.numbering.entry,
                requests.in_flight,
                self._rings,
                self._fence,
            )
        if slots is None:
            self._waiting.poll()
            return
        requests.deliver(slots)
        requests.has_news = False
        if self._waiting.wanted:
            self._watcher.wake()  # Another call may have what it waits for.

    def _hand_out(
        self, slots: NDArray[np.intp], *, synchronous: bool
    ) -> tuple[BatchedData, list[bool]]:
        """The results of `slots`, all ready; see `Core.hand_out`."""
        if self._conditions.unusual:
            return self._core.hand_out(slots, synchronous=synchronous)
        requests, results, continuity = self._requests, self._results, self._continuity
        try:
            part = results.part(self._layout.slabs[0], slots)
            parts = (part,)
            flagged = parts if b"\1" in part.flags.tobytes() else ()
            judged = continuity.judge(slots, flagged)
            is_cut = judged.is_cut
            if is_cut is not None:
                part.limit_reached = is_cut
                if continuity.mark_truncated:
                    part.flags[is_cut, ..., TRUNCATED] = True
            if flagged or is_cut is not None:
                results.add_episodes(part)
            batch = batch_of_results(parts, self._core, slots, part.names, results.sources(slots))
            self._watcher.check_interrupt()
            self._stats.account(parts, synchronous=synchronous)
            continuity.returned(slots, flagged, judged)
            if self._inline is not None:
                results.let_go(slots)
            requests.state[slots] = _IDLE
        except BaseException:
            requests.put_back(slots)
            raise
        if self._stats.num_batches >= self._hints.due:
            self._core.give_hints()
        return batch, [False] * len(slots) if is_cut is None else is_cut.tolist()
