"""Columns of values of several sizes, and of plain ones."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from kit.scripted import Counts

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.errors import BadAction
from rlightning_aio.spaces import Anything


class Cloud(Counts):
    """Observes one point more after each step; acts with as many."""

    length = 3

    def __init__(self, kind: str) -> None:
        points = spaces.Box(-9, 9, (3,))
        stacked = spaces.Sequence(points, stack=True)
        self.observation_space = Anything() if kind == "anything" else stacked
        self.action_space = self.observation_space

    def does(self, action: Any) -> None:
        assert action.shape == (self.steps + 1, 3)

    def observed(self) -> Any:
        return np.full((self.steps + 1, 3), self.steps + 1, np.float32)


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


class Obeying(Counts):
    """Acts with anything."""

    action_space = Anything()


@pytest.mark.parametrize("action", [("ab", "cd"), (["a", "b"], ["c", "d"]), ((1, 2), (3, 4))])
def test_a_tuple_is_no_list_of_actions(action: Any) -> None:
    """It is one of columns, of a Tuple space: none of its parts is turned over or taken apart."""
    with sync.build_env_group(Obeying, num_workers=2, placement="inline") as group:
        batch, _ = group.reset()
        with pytest.raises(BadAction, match="list"):
            group.step(batch.respond(action=action))
        batch, _ = group.step(batch.respond(action=list(action)))
        assert batch.sent.action == list(action)
