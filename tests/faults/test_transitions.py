"""A learner gets no transition that no env has made, whatever its envs do meanwhile."""

from __future__ import annotations

import itertools
import os
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from kit.scripted import DIE, HANG, RAISE, Scripted

from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.vector import VectorEnv

ENTRY: dict[str, Any] = {
    "step_timeout": 1.0,
    "on_env_error": "restart",
    "max_restarts": 100,
    "envs_per_process": 1,
}
FAULTS = ["env_raised", "env_died", "env_hung"]
NUM_STEPS = 15
"""More than eleven, so each env goes wrong."""
GAMMA, LAMBDA = 0.9, 0.8


class Numbered(Scripted):
    """Its observation is a random number of the episode, and that of steps.

    Every second episode of seven steps is truncated. Every eleventh step goes wrong, if any does.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, fault: str = "") -> None:
        self.fault, self.count = fault, itertools.count(1)

    def does(self, action: Any) -> Any:
        if self.fault and next(self.count) % 11 == 0:
            super().does({"env_raised": RAISE, "env_died": DIE, "env_hung": HANG}[self.fault])
        ends, is_cut = self.steps == 6, self.number % 2 == 1
        self.over, self.cut = ends and not is_cut, ends and is_cut
        return earned(np.array([self.number, self.steps + 1.0]))

    def observed(self) -> Any:
        if not self.steps:
            self.number = int.from_bytes(os.urandom(6), "little")
        return np.array([self.number, self.steps], np.float64)


def earned(observation: Any) -> Any:
    """Rewards of the steps that have led to observations."""
    return observation[..., 0] % 1000 + observation[..., 1]


def makers() -> list[Any]:
    """One env for each fault, and one without."""
    return [partial(Numbered, fault) for fault in [*FAULTS, ""]]


def assert_true(before: Any, after: Any, reward: Any, terminated: Any, truncated: Any) -> None:
    """Compare transitions with what such an env does."""
    np.testing.assert_array_equal(after - before, np.broadcast_to([0, 1], after.shape))
    np.testing.assert_array_equal(reward, earned(after))
    ends, is_cut = after[..., 1] == 7, after[..., 0] % 2 == 1
    np.testing.assert_array_equal(terminated, ends & ~is_cut)
    np.testing.assert_array_equal(truncated, ends & is_cut)


@pytest.mark.parametrize("options", [{"min_results": 4}, {"wait_all": True}], ids=str)
def test_a_collector_leaves_out_what_was_lost(options: dict[str, Any]) -> None:
    """The transition before it is an end, with the observation that was shown then."""

    def policy(batch: Any) -> dict[str, Any]:
        return {"action": np.zeros(len(batch), int), "seen": batch.observation.copy()}

    with sync.build_env_group(name="env", task=makers(), **ENTRY) as group:
        collector = Collector(group, policy, num_transitions=4 * NUM_STEPS, **options)
        for _ in range(2):
            rollout = collector.collect()
            assert_true(
                rollout.observation,
                rollout.next_observation,
                rollout.reward,
                rollout.terminated,
                rollout.truncated,
            )
            np.testing.assert_array_equal(rollout.seen, rollout.observation)
            np.testing.assert_array_equal(rollout.first, rollout.observation[..., 1] == 0)
            found = rollout.advantages(
                value(rollout.observation), value(rollout.end_observation), GAMMA, LAMBDA
            )
            np.testing.assert_allclose(found, advantages(rollout))
        metrics = group.metrics()
    assert all(metrics[f"envs/outcomes_{fault}"] > 0 for fault in FAULTS)


def value(observation: Any) -> Any:
    """What a value function might say of observations."""
    return 7 * observation[..., 1] - observation[..., 0] % 100


def advantages(rollout: Any) -> Any:
    """Advantages by the formula, from what each transition says of itself."""
    found = np.zeros(rollout.shape)
    after = np.where(rollout.terminated, 0, value(rollout.next_observation))
    errors = rollout.reward + GAMMA * after - value(rollout.observation)
    newest: dict[tuple[int, float], float] = {}
    for place in reversed([*np.ndindex(rollout.shape)]):
        episode = rollout.index[place].item(), rollout.observation[place][0].item()
        newest[episode] = errors[place] + GAMMA * LAMBDA * newest.get(episode, 0.0)
        found[place] = newest[episode]
    return found


def test_a_vector_env_cuts_the_episode_at_what_was_lost() -> None:
    """It has a row for each step: that of a lost one ends where the episode was seen last."""
    envs = VectorEnv(makers(), autoreset_mode=AutoresetMode.SAME_STEP, **ENTRY)
    before, _ = envs.reset(seed=0)
    num_lost = np.zeros(4, int)
    for _ in range(NUM_STEPS):
        shown, reward, terminated, truncated, infos = envs.step(np.zeros(4, int))
        lost = infos.get("_worker_restarted", np.zeros(4, bool))
        num_lost += lost
        after, done = shown.copy(), terminated | truncated
        for k in np.flatnonzero(done):
            after[k] = infos["final_obs"][k]
            assert shown[k, 1] == 0
        true = ~lost
        assert_true(before[true], after[true], reward[true], terminated[true], truncated[true])
        np.testing.assert_array_equal(after[lost], before[lost])
        assert truncated[lost].all()
        assert not reward[lost].any()
        assert not terminated[lost].any()
        before = shown
    envs.close()
    assert (num_lost[:3] > 0).all()
