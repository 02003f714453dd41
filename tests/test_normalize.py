"""Running normalisation against lists of all values, and against Gymnasium's wrappers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from collecting.scripted import KINDS, Script, scripted_group
from group import sample_envs
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio import BatchedData, PolicyResponse, sync
from rlightning_aio.batch.data import parts_of
from rlightning_aio.normalize import Normalizer
from rlightning_aio.protocol.slab import TRUNCATED

if TYPE_CHECKING:
    from pathlib import Path

assert sample_envs  # Registers its envs.

# The weight of the initial statistics, with mean 0 and variance 1.
FIRST = 1e-4


def moments(values: list[Any]) -> tuple[Any, Any]:
    """Return mean and variance of `values` and the initial statistics."""
    total = len(values) + FIRST
    mean = np.sum(values, axis=0) / total
    squares = np.sum([(value - mean) ** 2 for value in values], axis=0)
    return mean, (squares + FIRST * (1 + mean**2)) / total


def normal(value: Any, values: list[Any]) -> Any:
    mean, variance = moments(values)
    return np.clip((value - mean) / np.sqrt(variance + 1e-8), -10, 10)


class Lists:
    """Every observation and discounted return, of all envs."""

    def __init__(self, gamma: float) -> None:
        self.gamma = gamma
        self.observations: list[Any] = []
        self.returns: list[float] = []
        self.current: dict[int, float] = {}

    def note(self, env: int, observation: Any, reward: float, *, is_reset: bool, done: bool) -> Any:
        self.observations.append(observation)
        if is_reset:
            self.current[env] = 0.0
            return
        self.current[env] = self.current[env] * self.gamma + reward
        self.returns.append(self.current[env])
        if done:
            self.current[env] = 0.0

    def scaled(self, reward: Any) -> Any:
        _, variance = moments(self.returns)
        return np.clip(reward / np.sqrt(variance + 1e-8), -10, 10)


def observe(normalizer: Normalizer, lists: Lists, batch: BatchedData) -> None:
    """Record a batch twice, and compare."""
    seen = normalizer.observe(batch)
    assert seen.dtype == np.float32
    assert seen.shape == batch.observation.shape
    rows = [column.reshape(-1).tolist() for column in (
        batch.index, batch.reward, batch.is_reset, batch.done
    )]  # fmt: skip
    observations = batch.observation.reshape(-1, 3)
    for k, (env, reward, is_reset, done) in enumerate(zip(*rows, strict=True)):
        lists.note(env, observations[k], reward, is_reset=is_reset, done=done)
    expected = normal(observations, lists.observations)
    np.testing.assert_allclose(seen.reshape(-1, 3), expected, rtol=1e-4, atol=1e-4)


@given(st.data(), st.sampled_from([*KINDS]))
def test_values_are_normalised_by_all_results_of_all_envs(data: Any, kind: str) -> None:
    """In any order of results; returns start again at resets, ends and losses."""
    draw = data.draw
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    group = scripted_group(kind, draw(st.integers(1, 4)), draw(st.sampled_from([0.1, 0.5])))
    gamma = draw(st.sampled_from([0.0, 0.5, 0.99]))
    normalizer, lists = Normalizer(gamma), Lists(gamma)
    with group, group.auto_reset(math.inf):
        batch, _ = group.reset()
        action = np.zeros((*batch.is_reset.shape[1:], 1))
        observe(normalizer, lists, batch)
        for _ in range(20):
            some = generator.permutation(group.env_ids)[: generator.integers(1, len(group) + 1)]
            ids: list[str] = some.tolist()
            if (chance := generator.random()) < 0.1:
                batch, _ = group.reset(env_ids=ids)
                for part in parts_of(batch):  # As of an env whose worker was replaced.
                    part.flags[..., TRUNCATED] = chance < 0.05
            else:
                responses = [PolicyResponse(env_id, action) for env_id in ids]
                batch, _ = group.step(BatchedData(ids, responses))
            observe(normalizer, lists, batch)
    found, reward = normalizer.normalized(batch.observation), batch.reward
    expected = normal(batch.observation, lists.observations), lists.scaled(reward)
    np.testing.assert_allclose(found, expected[0], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(normalizer.scaled(reward), expected[1], rtol=1e-4, atol=1e-4)


def trees(generator: np.random.Generator, count: int) -> dict[str, Any]:
    return {
        "image": generator.integers(256, size=(count, 4, 4, 3), dtype=np.uint8),
        "arm": (generator.normal(3, 2, (count, 2)), generator.integers(5, size=count)),
        "speed": generator.normal(size=count).astype(np.float32),
    }


def test_each_array_of_a_tree_has_its_own_statistics() -> None:
    """Integers are returned as they are."""
    generator = np.random.default_rng(0)
    whole, arm, speed = Normalizer(), Normalizer(), Normalizer()
    for _ in range(20):
        given_tree = trees(generator, 4)
        found = whole.update_observations(given_tree)
        np.testing.assert_array_equal(found["image"], given_tree["image"])
        np.testing.assert_array_equal(found["arm"][1], given_tree["arm"][1])
        one = arm.update_observations(given_tree["arm"][0])
        np.testing.assert_array_equal(found["arm"][0], one)
        one = speed.update_observations(given_tree["speed"])
        np.testing.assert_array_equal(found["speed"], one)


def test_it_continues_where_it_was_saved(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    saved = Normalizer()
    index = np.arange(3)

    def next_of(normalizer: Normalizer, seed: int) -> tuple[Any, Any]:
        own = np.random.default_rng(seed)
        tree, starts = trees(own, 3), own.random(3) < 0.2
        scaled = normalizer.update_rewards(index, own.normal(size=3), starts)
        return normalizer.update_observations(tree), scaled

    for _ in range(5):
        next_of(saved, int(generator.integers(99)))
    np.savez(tmp_path / "normalizer.npz", **saved.state_dict())
    loaded = Normalizer()
    with np.load(tmp_path / "normalizer.npz") as state:
        loaded.load_state_dict(state)
    for seed in range(3):
        (one, one_reward), (other, other_reward) = next_of(saved, seed), next_of(loaded, seed)
        np.testing.assert_array_equal(one["arm"][0], other["arm"][0])
        np.testing.assert_array_equal(one["speed"], other["speed"])
        np.testing.assert_array_equal(one_reward, other_reward)


def test_a_state_that_lacks_a_part_changes_nothing() -> None:
    normalizer, index = Normalizer(), np.arange(2)
    normalizer.update_observations(np.ones((2, 3)))
    normalizer.update_rewards(index, np.ones(2), np.ones(2, np.bool_))
    before = normalizer.state_dict()
    state = {name: value + 1 for name, value in before.items() if name != "return.count"}
    with pytest.raises(KeyError, match="count"):
        normalizer.load_state_dict(state)
    for name, value in normalizer.state_dict().items():
        np.testing.assert_array_equal(value, before[name])


def test_values_equal_those_of_gymnasiums_wrappers() -> None:
    """Observations bit for bit."""
    normalizer, index = Normalizer(0.9), np.arange(3)

    def made() -> Any:
        return SyncVectorEnv([lambda k=k: Script(k, 0.0) for k in range(3)])

    bare, wrapped = made(), NormalizeReward(NormalizeObservation(made()), gamma=0.9)
    theirs = wrapped.reset()[0]
    ours = normalizer.update_observations(bare.reset()[0])
    np.testing.assert_array_equal(ours, np.clip(theirs, -10, 10))
    for _ in range(60):
        theirs, their_reward, *_ = wrapped.step(np.zeros((3, 1)))
        observation, reward, terminated, *_ = bare.step(np.zeros((3, 1)))
        scaled = normalizer.update_rewards(index, reward, terminated)
        # Gymnasium adds up returns in single precision.
        np.testing.assert_allclose(scaled, np.clip(their_reward, -10, 10), rtol=1e-6)
        seen = normalizer.update_observations(observation)
        np.testing.assert_array_equal(seen, np.clip(theirs, -10, 10))


def test_each_half_can_be_left_out() -> None:
    index, observation = np.arange(2), np.array([[5.0], [7.0]])
    reward, starts = np.array([3.0, 4.0]), np.ones(2, bool)
    observations = Normalizer(rewards=False)
    assert observations.update_rewards(index, reward, starts).tolist() == [3, 4]
    assert observations.scaled(reward).tolist() == [3, 4]
    assert (observations.update_observations(observation) < 5).all()
    rewards = Normalizer(observations=False)
    for found in (rewards.update_observations(observation), rewards.normalized(observation)):
        assert found.dtype == np.float32
        assert found.tolist() == [[5.0], [7.0]]
    assert rewards.update_rewards(index, reward, starts).tolist() != [3, 4]


def test_rewards_of_several_agents_are_refused() -> None:
    crowd = {"name": "crowd", "backend": "crowd", "task": "-", "placement": "inline"}
    with sync.build_env_group(crowd) as group:
        batch, _ = group.reset()
        with pytest.raises(TypeError, match="give rewards=False"):
            Normalizer().observe(batch)
        seen = Normalizer(rewards=False).observe(batch)
    assert seen["tall"].dtype == np.float32
