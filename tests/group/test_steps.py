"""Ordinary and other steps give the same results, whatever happens in between."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pytest
from group.fake_host import (
    PLAIN,
    RAISES,
    SENDS_INFO,
    TERMINATES,
    TRUNCATES,
    FakeGroup,
    FakeWorker,
    Running,
)
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from kit.driven import without_times

from rlightning_aio._core.group.engine.steps import CollectRules
from rlightning_aio._core.group.state.conditions import UNLIKE_ENVS
from rlightning_aio._core.group.timeline import Trace
from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import RLightningError
from rlightning_aio.protocol import kernel

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.usefixtures("implementation")

ACTIONS = st.sampled_from((PLAIN,) * 6 + (TERMINATES, TRUNCATES, RAISES, SENDS_INFO))


def plain(outcome: Any) -> Any:
    """Return the content of a result or an error as plain data, without times."""
    if isinstance(outcome, tuple) and outcome and isinstance(outcome[0], BatchedData):
        batch, flags = outcome
        return seen(batch), flags
    if isinstance(outcome, BaseException):
        results = getattr(outcome, "results", None)
        others = [plain(other) for other in getattr(outcome, "others", ())]
        return type(outcome), str(outcome), results and seen(results), others
    return outcome


def seen(batch: BatchedData) -> Any:
    if not len(batch):
        return []
    columns = (batch.observation, batch.reward, batch.terminated, batch.truncated, batch.done)
    flags = (batch.is_reset, batch.limit_reached, batch.restarted, batch.index)
    sent = {name: np.asarray(batch.sent[name]).tolist() for name in sorted(batch.sent)}
    return repr((batch.ids(), [c.tolist() for c in (*columns, *flags)], batch.info(), sent))


class Twins(RuleBasedStateMachine):
    """Two groups with the same events: one steps as it chooses, one never has ordinary steps."""

    @initialize(rows=st.lists(st.integers(1, 3), min_size=1, max_size=3), limit=st.integers(1, 4))
    def start(self, rows: list[int], limit: int) -> None:
        self.groups = [FakeGroup(rows, max_episode_steps=limit, max_restarts=3) for _ in range(2)]
        self.firsts: list[BatchedData] = []
        self.count = sum(rows)
        self.operations: list[list[Running]] = []
        self.collectors: list[Running] = []
        self.traces: list[Trace] = []
        self.folder = tempfile.TemporaryDirectory()
        self.in_context = False
        for group in self.groups:
            running = group.begin(group.core.reset(group.now, None, None, None))
            self.finish_all(group)
            self.firsts.append(running.result()[0])
        self.groups[1].conditions.note(UNLIKE_ENVS, True)
        assert not self.groups[0].conditions.unusual

    @staticmethod
    def finish_all(group: FakeGroup) -> None:
        for host in group.hosts:
            while host.waiting:
                group.finish(host.first_slot + host.waiting[0][0])

    def teardown(self) -> None:
        if hasattr(self, "groups"):
            for trace in self.traces:
                trace.stop()
            for group in self.groups:
                group.close()
            self.folder.cleanup()

    def both(self, deed: Callable[[FakeGroup, BatchedData], Any]) -> list[Any]:
        """Do something to both groups; the outcomes or errors must be equal."""
        outcomes: list[Any] = []
        for group, first in zip(self.groups, self.firsts, strict=True):
            try:
                outcomes.append(deed(group, first))
            except (RLightningError, ValueError, TypeError) as error:
                outcomes.append(error)
        if not isinstance(outcomes[0], Running):
            assert plain(outcomes[0]) == plain(outcomes[1])
        return outcomes

    # -- operations

    def batch(self, data: st.DataObject) -> Callable[[BatchedData], BatchedData]:
        """Return a batch that answers results of some envs, idle or not."""
        slots = data.draw(st.lists(st.integers(0, self.count - 1), unique=True, min_size=1))
        everyone = data.draw(st.booleans())
        count = self.count if everyone else len(slots)
        actions = data.draw(st.lists(ACTIONS, min_size=count, max_size=count))
        kind = data.draw(st.sampled_from((np.int64, np.int64, np.int64, np.int32, np.float64)))
        extras = {"value": np.arange(count)} if data.draw(st.booleans()) else {}

        def respond(first: BatchedData) -> BatchedData:
            results = first if everyone else first.take(slots)
            return results.respond(action=np.array(actions, kind), **extras)

        return respond

    @rule(data=st.data())
    def step_async(self, data: st.DataObject) -> None:
        respond = self.batch(data)
        self.both(lambda group, first: group.steps.step_async(respond(first), group.now))

    @rule(data=st.data())
    def step(self, data: st.DataObject) -> None:
        respond = self.batch(data)
        self.operations.append(
            self.both(lambda group, first: group.begin(group.steps.step(respond(first), group.now)))
        )

    @precondition(lambda self: not self.collectors)
    @rule(
        wait_all=st.booleans(),
        min_results=st.integers(1, 4),
        max_results=st.sampled_from((None, None, 4)),
    )
    def collect(self, **rules: Any) -> None:
        self.collectors = self.both(
            lambda group, _: group.begin(group.steps.collect(group.now, CollectRules(**rules)))
        )

    @rule(slot=st.integers(0, 8))
    def reset(self, slot: int) -> None:
        ids = [f"fake-{slot % self.count}"]
        self.operations.append(
            self.both(lambda group, _: group.begin(group.core.reset(group.now, 7, None, ids)))
        )

    @rule(slot=st.integers(0, 8), name=st.sampled_from(("who", "raise")))
    def call(self, slot: int, name: str) -> None:
        self.operations.append(
            self.both(
                lambda group, _: group.begin(
                    group.core.calls.call_one(group.now, slot % self.count, (name, (), {}))
                )
            )
        )

    @precondition(lambda self: self.operations)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        running = self.operations.pop(data.draw(st.integers(0, len(self.operations) - 1)))
        self.both(lambda group, _: group.cancel(self.of(running, group)))

    @precondition(lambda self: self.collectors)
    @rule()
    def cancel_collect(self) -> None:
        collectors, self.collectors = self.collectors, []
        self.both(lambda group, _: group.cancel(self.of(collectors, group)))

    def of(self, running: list[Running], group: FakeGroup) -> Running:
        return running[self.groups.index(group)]

    # -- events between steps

    def waiting(self) -> list[int]:
        hosts = self.groups[0].hosts
        return [host.first_slot + index for host in hosts for index, _ in host.waiting]

    @precondition(waiting)
    @rule(data=st.data(), newest_first=st.booleans())
    def finish(self, data: st.DataObject, newest_first: bool) -> None:
        slot = data.draw(st.sampled_from(self.waiting()))
        self.both(lambda group, _: group.finish(slot, newest_first=newest_first))

    @precondition(waiting)
    @rule()
    def finish_everything(self) -> None:
        self.both(lambda group, _: self.finish_all(group))

    def alive(self) -> list[int]:
        hosts = self.groups[0].hosts
        return [k for k, h in enumerate(hosts) if isinstance(h, FakeWorker) and h.alive]

    @precondition(alive)
    @rule(data=st.data(), refusals=st.sampled_from((0, 0, 1)))
    def die(self, data: st.DataObject, refusals: int) -> None:
        number = data.draw(st.sampled_from(self.alive()))

        def kill(group: FakeGroup, _: BatchedData) -> None:
            group.hosts[number].refusals = refusals
            group.hosts[number].die()
            group.wake()
            group.turn()

        self.both(kill)

    @rule(seconds=st.sampled_from((0.01, 0.5)))
    def pass_time(self, seconds: float) -> None:
        self.both(lambda group, _: group.pass_time(seconds))

    @rule(limit=st.sampled_from((None, 1, 3)), on_done=st.booleans())
    def auto_reset(self, limit: int | None, on_done: bool) -> None:
        for group in self.groups:
            episodes = group.core.episodes
            if self.in_context:
                episodes.end()
            elif limit is None or limit == group.config.max_episode_steps:
                episodes.begin(None, on_done=on_done)
            else:
                with pytest.warns(UserWarning, match="overrides"):
                    episodes.begin(limit, on_done=on_done)
        self.in_context = not self.in_context

    @rule()
    def record(self) -> None:
        """Start or stop a timeline."""
        if self.traces:
            for trace in self.traces:
                trace.stop()
            self.traces = []
            return
        path = Path(self.folder.name) / "run.json"
        self.traces = [Trace(group.core, path, []) for group in self.groups]
        for trace in self.traces:
            trace.start()

    # -- comparisons

    @invariant()
    def nothing_is_different(self) -> None:
        if not hasattr(self, "groups"):
            return
        for running in [*self.operations, self.collectors]:
            if not running or not isinstance(running[0], Running):
                continue
            assert running[0].done == running[1].done
            if running[0].done:
                outcomes = [plain(one.error or one.value) for one in running]
                assert outcomes[0] == outcomes[1]
        self.operations = [
            r for r in self.operations if isinstance(r[0], Running) and not r[0].done
        ]
        if self.collectors and self.collectors[0].done:
            self.collectors = []
        ordinary, general = (group.core.requests for group in self.groups)
        assert ordinary.numbering.entry.tolist() == general.numbering.entry.tolist()
        assert ordinary.state.tolist() == general.state.tolist()
        assert np.sign(ordinary.owner).tolist() == np.sign(general.owner).tolist()
        assert ordinary.in_flight == general.in_flight
        for name in ("num_ready", "num_awaited"):
            assert getattr(ordinary.collector, name) == getattr(general.collector, name), name
        stats = [
            {env_id: without_times(own) for env_id, own in group.core.sums.by_env().items()}
            for group in self.groups
        ]
        assert stats[0] == stats[1]
        active = [group.conditions.unusual & ~UNLIKE_ENVS for group in self.groups]
        assert active[0] == active[1]


def test_steps() -> None:
    """Both paths, in any order of events."""
    run_state_machine_as_test(Twins, settings=settings(stateful_step_count=50))


def test_steps_are_ordinary_before_and_after_a_death() -> None:
    """Steps are not ordinary until the replacement has shown that it works."""
    group = FakeGroup([2, 2])
    running = group.begin(group.core.reset(group.now, None, None, None))
    Twins.finish_all(group)
    batch, _ = running.result()
    published: list[bool] = []

    def turn() -> None:
        nonlocal batch
        with patch.object(kernel, "submit", wraps=kernel.submit) as submit:
            step = group.steps.step(batch.respond(action=np.full(4, PLAIN)), group.now)
            running = group.begin(step)
        published.append(submit.called)
        Twins.finish_all(group)
        batch, _ = running.result()

    turn()
    group.hosts[0].die()
    group.turn()
    for _ in range(3):
        turn()
    assert published == [True, False, False, True]
    group.close()
