"""Columns of plain values after results of several batches were joined."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.errors import BadAction
from rlightning_aio.spaces import Anything


class Counting:
    """Observes lists of one length, which could all be stacked to an array; see `step`."""

    observation_space = spaces.Dict(
        word=Anything(), pair=spaces.Tuple([Anything(), spaces.Box(0, 99, (), np.float32)])
    )
    action_space = Anything()

    def _observation(self) -> dict[str, Any]:
        return {"word": ["count", self.count], "pair": ([self.count], self.count)}

    async def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.count = 0
        return self._observation(), {}

    async def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """End if the action says so."""
        self.count += 1
        return self._observation(), 1.0, action == "end", False, {}


def check(observation: Any) -> None:
    """Each row has values of one count, as they are."""
    numbers, exact = observation["pair"]
    for word, number, count in zip(observation["word"], numbers, exact.tolist(), strict=True):
        assert word == ["count", count]
        assert number == [count]
        assert type(word[1]) is int


async def test_blocks_hold_values_of_envs_that_are_reset_apart() -> None:
    """Results of those that were not are joined to the others' first observations."""

    def policy(batch: rl.BatchedData) -> dict[str, Any]:
        check(batch.observation)
        return {"action": ["end" if k == 1 else "on" for k in range(len(batch))]}

    config = rl.EnvConfig(name="c", task=Counting, num_workers=3, placement="loop")
    async with rl.build_env_group(config) as group:
        with group.auto_reset(math.inf):
            collector = Collector(group, policy, num_transitions=15, wait_all=True)
            for _ in range(2):
                rollout = await collector.collect()
                counts = [[word[1] for word in row] for row in rollout.observation["word"]]
                assert [row[1] for row in counts] == [0] * 5
                assert counts[0][0] in (0, 5)


class Cloud(gym.Env[Any, Any]):
    """Observes one point more after each step, and tells of the newest action."""

    def __init__(self, kind: str) -> None:
        points = spaces.Box(-9, 9, (3,))
        stacked = spaces.Sequence(points, stack=True)
        self.observation_space = Anything() if kind == "anything" else stacked
        self.action_space = self.observation_space

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.count = 1
        return np.full((1, 3), 1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action.shape == (self.count, 3)
        self.count += 1
        observation = np.full((self.count, 3), self.count, np.float32)
        return observation, 1.0, self.count == 4, False, {}


@pytest.mark.parametrize("placement", ["inline", "process"])
@pytest.mark.parametrize("kind", ["anything", "sequence"])
@pytest.mark.parametrize("wait_all", [True, False])
def test_values_of_several_sizes_are_collected(placement: str, kind: str, wait_all: bool) -> None:
    """Each is a value of its own, also where those of the first batch are all of one size."""
    config = rl.EnvConfig(
        name="c", task=Cloud, num_workers=2, placement=placement, env_kwargs={"kind": kind}
    )

    def policy(batch: rl.BatchedData) -> Any:
        return {
            "action": list(batch.observation),
            "sizes": [[0] * len(o) for o in batch.observation],
        }

    with sync.build_env_group(config) as group, group.auto_reset(math.inf):
        collector = Collector(group, policy, num_transitions=12, wait_all=wait_all)
        for _ in range(2):
            rollout = collector.collect()
            assert rollout.env_ids == {0: "c-0", 1: "c-1"}
            observations, actions = rollout.observation, rollout["action"]
            if wait_all:
                observations, actions = itertools.chain(*observations), itertools.chain(*actions)
            shapes = Counter()
            for observation, action in zip(observations, actions, strict=True):
                assert np.array_equal(observation, action)
                assert len(observation) == observation[0, 0]
                shapes[len(observation)] += 1
            assert shapes.keys() == {1, 2, 3}
            assert {len(one) for one in rollout.end_observation} <= {1, 2, 3, 4}


def test_a_policys_values_of_several_sizes_are_refused_with_what_to_do() -> None:
    """Arrays are columns; lists are values."""

    def policy(batch: rl.BatchedData) -> Any:
        sizes = [np.zeros(len(one)) for one in batch.observation]
        return {"action": list(batch.observation), "sizes": sizes}

    config = rl.EnvConfig(
        name="c", task=Cloud, num_workers=1, placement="inline", env_kwargs={"kind": "anything"}
    )
    with sync.build_env_group(config) as group, group.auto_reset(math.inf):
        collector = Collector(group, policy, num_transitions=12)
        with pytest.raises(ValueError, match=r"several sizes as lists, such as array.tolist\(\)"):
            collector.collect()


@pytest.mark.parametrize("action", [("ab", "cd"), (["a", "b"], ["c", "d"]), ((1, 2), (3, 4))])
async def test_a_tuple_is_no_list_of_actions(action: Any) -> None:
    """It is one of columns, of a Tuple space: none of its parts is turned over or taken apart."""
    config = rl.EnvConfig(name="c", task=Counting, num_workers=2, placement="loop")
    async with rl.build_env_group(config) as group:
        batch, _ = await group.reset()
        with pytest.raises(BadAction, match="list"):
            await group.step(batch.respond(action=action))
        batch, _ = await group.step(batch.respond(action=list(action)))
        assert batch.sent.action == list(action)
