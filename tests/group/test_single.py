"""A group of inline envs executes its steps at once, and otherwise behaves as any group."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from group import sample_envs
from group.sample_envs import HALVED
from hypothesis import given
from hypothesis import strategies as st
from kit.driven import without_times

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio._core.group.engine.core import Core
from rlightning_aio._core.group.state.conditions import UNLIKE_ENVS
from rlightning_aio.errors import EnvBusy, EnvRaised

PROBE = HALVED | {"backend": "probe"}
TWO = {"num_workers": 2}
CARTPOLE = HALVED | {"backend": "gymnasium", "task": "CartPole-v1"}


def action_of(backend: str, number: int) -> Any:
    """Return an action of every backend for a number up to 9: a step, an end or an error."""
    if backend == "probe":
        return np.array([number % 4, number], float)
    return number % 2 if backend == "gymnasium" else number


def steps_at_once(group: rlightning_aio.sync.EnvGroup) -> bool:
    """Return True if the only env of a group is stepped without a request."""
    return group._steps._alone is not None


class Used:
    """A group and operations on it; each returns its outcome as plain data."""

    def __init__(self, entry: dict[str, Any], *, ordinary: bool) -> None:
        self.group = rlightning_aio.sync.build_env_group(entry)
        self.group.init()
        conditions = self.group._core.tables.conditions
        if not ordinary:
            conditions.note(UNLIKE_ENVS, True)
        self.backend = entry["backend"]
        self.batch, _ = self.group.reset(seed=1)
        self.context = ExitStack()

    def outcome(self, deed: str, number: int) -> Any:
        try:
            return getattr(self, deed)(number)
        except (rlightning_aio.RLightningError, ValueError, RuntimeError) as error:
            return type(error), str(error)

    def _results(self, results: tuple[BatchedData, Any]) -> Any:
        self.batch, flags = results
        values = self.batch.values()
        outcome = [(one.model_dump(exclude={"ts_env_sent_ns"}), one._extra) for one in values]
        batch = self.batch
        columns = (batch.observation, batch.reward, batch.terminated, batch.done, batch.infos)
        rows = (batch.is_reset, batch.limit_reached, batch.restarted, batch.index)
        sent = {name: batch.sent[name] for name in batch.sent}
        return repr((outcome, columns, rows, sent, flags))

    def _action(self, number: int) -> Any:
        return np.array([action_of(self.backend, number)] * len(self.batch))

    def step(self, number: int) -> Any:
        action = self._action(number)
        return self._results(self.group.step(self.batch.respond(action=action)))

    def step_with_extras(self, number: int) -> Any:
        response = self.batch.respond(action=self._action(number), value=[number] * len(self.batch))
        return self._results(self.group.step(response))

    def step_by_hand(self, number: int) -> Any:
        response = PolicyResponse("one-0", action_of(self.backend, number), log_prob=0.5)
        return self._results(self.group.step(BatchedData(["one-0"], [response])))

    def send(self, number: int) -> Any:
        action = self._action(number)
        self.group.step_async(self.batch.respond(action=action))

    def collect(self, number: int) -> Any:
        return self._results(self.group.collect_async(max_results=1 + number % 2))

    def reset(self, number: int) -> Any:
        return self._results(self.group.reset(seed=number, options={"n": 1} if number else None))

    def misfit(self, number: int) -> Any:
        return self._results(
            self.group.step(self.batch.respond(action=np.zeros((len(self.batch), 3, 3))))
        )

    def of_nobody(self, number: int) -> Any:
        return len(self.group.step(BatchedData())[0])

    def call(self, number: int) -> Any:
        return self.group["one-0"].get_attr("spec")

    def open_context(self, number: int) -> Any:
        self.context.enter_context(self.group.auto_reset(max_episode_steps=1 + number))

    def close_context(self, number: int) -> Any:
        self.context.close()

    def close(self) -> Any:
        stats = {id_: without_times(own) for id_, own in self.group.get_env_stats().items()}
        self.context.close()
        self.group.close()
        return stats


# Interrupts have their own tests.
INTERRUPTS = (sample_envs.Halved.INTERRUPT, sample_envs.Halved.INTERRUPT_START)
NUMBERS = st.sampled_from([number for number in range(10) if number not in INTERRUPTS])
DEEDS = [name for name in vars(Used) if name[0] != "_" and name not in ("outcome", "close")]


@pytest.mark.parametrize(
    "entry",
    [HALVED, PROBE, CARTPOLE, HALVED | TWO, CARTPOLE | TWO],
    ids=lambda entry: f"{entry.get('num_workers', 1)} {entry['backend']}",
)
@given(deeds=st.lists(st.tuples(st.sampled_from(["step", *DEEDS]), NUMBERS), max_size=25))
def test_nothing_but_the_time_is_different(
    entry: dict[str, Any], deeds: list[tuple[str, int]]
) -> None:
    """Results, errors, flags and sums equal those of steps that are not ordinary."""
    single, general = Used(entry, ordinary=True), Used(entry, ordinary=False)
    for deed, number in deeds:
        assert single.outcome(deed, number) == general.outcome(deed, number), deed
    assert single.close() == general.close()


def test_a_step_that_raises_counts_towards_no_limit(halved: rlightning_aio.sync.EnvGroup) -> None:
    """The limit counts completed steps."""
    batch, _ = halved.reset()
    with halved.auto_reset(max_episode_steps=3):
        with pytest.raises(EnvRaised):
            halved.step(batch.respond(action=np.array([8])))
        for expected in (False, False, True):
            batch, flags = halved.step(batch.respond(action=np.array([1])))
            assert flags == [expected]


def test_it_is_used_for_one_inline_env_alone() -> None:
    """Not for two envs, nor for an env in a worker."""
    for fields, at_once in (
        ({}, True),
        (TWO, False),
        ({"placement": "process"}, False),
    ):
        with rlightning_aio.sync.build_env_group(HALVED | fields) as group:
            assert steps_at_once(group) == at_once


def test_an_interrupt_ends_the_step_that_it_strikes(halved: rlightning_aio.sync.EnvGroup) -> None:
    """The program gets it, and the group continues, once the error of the step is collected."""
    batch, _ = halved.reset()
    with pytest.raises(KeyboardInterrupt):
        halved.step(batch.respond(action=np.array([sample_envs.Halved.INTERRUPT])))
    assert halved.pending == halved.env_ids
    with pytest.raises(EnvBusy, match="collect it first"):
        halved.step(batch.respond(action=np.array([3])))
    with pytest.raises(EnvRaised, match="KeyboardInterrupt"):
        halved.collect_async()
    batch, _ = halved.step(batch.respond(action=np.array([3])))
    assert batch.reward.tolist() == [3]


async def test_other_tasks_have_their_turns() -> None:
    """A loop over an env that never waits lets other tasks run."""
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    async with rlightning_aio.build_env_group(HALVED) as group:
        batch, _ = await group.reset()
        task = asyncio.create_task(count())
        for _ in range(50):
            batch, _ = await group.step(batch.respond(action=np.array([0])))
        task.cancel()
    assert turns >= 50


async def test_an_asynchronous_group_has_the_general_core() -> None:
    """Other tasks may send, cancel and collect in the middle of a step."""
    async with rlightning_aio.build_env_group(HALVED) as group:
        assert type(group._core) is Core
