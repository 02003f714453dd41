"""The core: the operations of a group for every case, without waiting itself.

It connects the parts of a group, none of which calls it back. Its procedures are generators that
yield a `Wait` when they need a reply; the driver blocks until a source is readable or the time has
come, calls `apply_completions`, and sends the time in. Both kinds of group run through it.
Rule: no I/O beyond passing bytes to hosts, no waiting, no event loop.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.group.engine.aborts import Aborts
from rlightning_aio._core.group.engine.agent_steps import AgentSteps
from rlightning_aio._core.group.engine.calls import Calls
from rlightning_aio._core.group.engine.intake import Intake
from rlightning_aio._core.group.engine.resets import Resets
from rlightning_aio._core.group.engine.results import Results
from rlightning_aio._core.group.engine.snapshots import Snapshots
from rlightning_aio._core.group.engine.steps import Steps
from rlightning_aio._core.group.engine.waiting import Waiting
from rlightning_aio._core.group.state.request_states import COLLECTOR, NOBODY, State
from rlightning_aio.errors import EnvFault

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.steps import Flags
    from rlightning_aio._core.group.engine.waiting import Poller
    from rlightning_aio._core.group.state.episodes import Seeds
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta


class Core:
    """The operations of an `EnvGroup`, by its names; others are those of `steps` and `calls`.

    Args:
        tables, supervisor, poller: of the group.
        zero_copy: return observations as views if their rows are contiguous.

    Attributes:
        tables, supervisor: as given; envs, requests, episodes, observed, lifetime, sums: of the
            tables; results, intake, waiting, steps, agent_steps, calls: made here.
    """

    def __init__(
        self, tables: Tables, supervisor: Supervisor, poller: Poller, *, zero_copy: bool
    ) -> None:
        self.tables = tables
        self.supervisor = supervisor
        self.envs = tables.envs
        self.requests = tables.requests
        self.episodes = tables.episodes
        self.observed = tables.observed
        self.lifetime = tables.lifetime
        self.sums = tables.sums
        self.results = results = Results(tables, zero_copy=zero_copy)
        supervisor.renewals.on_move = results.use_schemas
        self.intake = intake = Intake(tables, supervisor, results)
        self.apply_completions = intake.apply_completions
        self.waiting = waiting = Waiting(tables, supervisor, poller, intake)
        self.steps = Steps(tables, supervisor, results, waiting)
        self.calls = Calls(tables, supervisor, waiting)
        self._snapshots = Snapshots(tables, supervisor, self.calls, results, waiting)
        self._resets = Resets(tables, supervisor, results, waiting)
        self.agent_steps = AgentSteps(tables, self.steps, self._resets, self.calls, waiting)
        self._aborts = Aborts(tables, supervisor, results, waiting)

    # -- life -------------------------------------------------------------------------

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """Start the hosts."""
        with self.observed.call("init", now):
            metas = yield from self.supervisor.start(now)
        self.steps.begin()
        return metas

    def close(self, now: float) -> Procedure[None]:
        """Close the hosts."""
        return self.supervisor.shutdown.close(now)

    def describe_workers(self, now_ns: int) -> list[dict[str, Any]]:
        """Describe each host and its outstanding requests."""
        if self.lifetime.open:
            self.waiting.poll()  # Results that are ready are no longer outstanding.
        return self.supervisor.workers.describe(now_ns)

    def interrupted(self, now: float) -> str:
        """Stop hardware, as Ctrl-C has ended a call, and say which envs the call waited for."""
        self.tables.stop_hardware(self.envs.all.tolist())
        self.waiting.poll()
        return self.supervisor.workers.awaited(int(now * 1e9))

    # -- requests ---------------------------------------------------------------------

    def reset(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Reset envs and wait for all of them; without `env_ids`, drop what is in flight first."""
        with self.observed.call("reset", now):
            # What another call waits for is not dropped; the reset is refused then.
            others = self.waiting.collecting or np.count_nonzero(self.requests.owner > COLLECTOR)
            if env_ids is None and not others:
                self._resets.check(seed, options)  # Else what is in flight would be lost.
                self.supervisor.places.drop_of(COLLECTOR)
                with suppress(EnvFault):
                    yield from self._drain(now, None)
                self.drop_unraised()
                now = self.tables.clock()
            return self.steps.settled(*(yield from self._resets.reset(now, seed, options, env_ids)))

    def drop_unraised(self) -> None:
        """Drop the errors of losses that no request has raised, as a reset of all envs does."""
        self.tables.driver.read()
        self.apply_completions()
        self.supervisor.losses.drop_unraised()

    def reset_async(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> None:
        """Send resets, whose results `collect` returns."""
        with self.observed.call("reset_async", now):
            _, send = self._resets.prepared(now, seed, options, env_ids)
            send(None)
        self.waiting.wake()

    # -- ends without results ---------------------------------------------------------

    def abort(self, now: float, env_ids: Sequence[str] | None) -> Procedure[None]:
        """End the requests of envs, and drop their results."""
        with self.observed.call("abort", now):
            self.lifetime.check_open()
            slots = self.envs.all if env_ids is None else self.envs.find(env_ids)
            self.waiting.poll()
            self._aborts.drop(slots)
            yield from self._aborts.end(slots, now)

    def drain_requests(
        self, now: float, deadline: float | None
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Return the results of all that is in flight, and end what has none by the deadline."""
        with self.observed.call("drain", now):
            return (yield from self._drain(now, deadline))

    def _drain(self, now: float, deadline: float | None) -> Procedure[tuple[BatchedData, Flags]]:
        self.steps.check_collectable()
        collector, unwanted = self.requests.collector, self.requests.unwanted
        end = None if deadline is None else now + deadline
        self.waiting.collecting = now
        try:
            now = yield from self.waiting.until(
                now, lambda: collector.num_awaited + len(unwanted), end
            )
            if deadline is not None:
                yield from self._aborts.end(self.envs.all, now)
        finally:
            self.waiting.collecting = 0.0
        if collector.num_ready:
            results = self.steps.hand_out(collector.pop_ready(collector.num_ready))
        else:
            results = self.steps.nothing()
        if collector.faults:
            faults = [*collector.faults]
            for fault in faults:
                collector.take_fault(fault)
            faults[0].results, faults[0].others = results[0], tuple(faults[1:])
            raise faults[0]
        return results

    # -- states of envs ---------------------------------------------------------------

    def snapshot(self, now: float, env_ids: Sequence[str] | None) -> Procedure[bytes]:
        """Take a snapshot of envs."""
        with self.observed.call("snapshot", now):
            return (yield from self._snapshots.take(now, env_ids))

    def restore(
        self, now: float, data: bytes, env_ids: Sequence[str] | None, source: str | None
    ) -> Procedure[tuple[BatchedData, Flags]]:
        """Restore envs, and return their last results as first observations."""
        with self.observed.call("restore", now):
            replied = yield from self._snapshots.restore(now, data, env_ids, source)
            return self.steps.settled(*replied)

    def pending(self) -> list[str]:
        """Return the ids of envs whose result, value or error was not returned yet."""
        self.lifetime.check_open()
        self.intake.apply_completions()
        state, owner = self.requests.state, self.requests.owner
        return self.envs.names.ids(np.flatnonzero((state != State.IDLE) & (owner != NOBODY)))
