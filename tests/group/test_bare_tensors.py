"""Tensors of envs with a bare step: observations stay tensors inline; all else is arrays."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from rlightning_aio import EnvConfig, EnvRaised, sync
from rlightning_aio.trees import as_numpy, holds_tensor

BOX = spaces.Box(-99, 99, (2,), np.float64)


class Tensor:
    """Stands for a tensor on a GPU: NumPy can't read it."""

    __module__ = "torch"

    def __init__(self, array: Any) -> None:
        self.array = np.array(array)
        self.shape = self.array.shape
        self.dtype = self.array.dtype

    def __reduce__(self) -> Any:
        return _tensor, (self.array,)

    def __bool__(self) -> bool:
        return bool(self.array)

    def detach(self) -> Tensor:
        return self

    cpu = resolve_conj = resolve_neg = detach

    def numpy(self) -> Any:
        return self.array


def _tensor(array: Any) -> Tensor:
    return Tensor(array)


class Single(gym.Env[Any, Any]):
    """Counts its steps in tensors; an episode has three."""

    observation_space: Any = BOX
    action_space: Any = spaces.Discrete(2)
    head: tuple[int, ...] = ()

    def _of(self, value: float) -> Tensor:
        return Tensor(np.full(self.head, value))

    def _observation(self) -> Any:
        return Tensor(np.full((*self.head, 2), float(self.steps)))

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        ended = Tensor(np.full(self.head, self.steps >= 3))
        return self._observation(), self._of(self.steps), ended, self._of(0), {"at": self._of(1)}


class Several(Single, gym.vector.VectorEnv[Any, Any, Any]):
    num_envs = 3
    head = (3,)
    single_observation_space, single_action_space = BOX, spaces.Discrete(2)
    observation_space = gym.vector.utils.batch_space(BOX, 3)
    action_space = spaces.MultiDiscrete([2] * 3)
    metadata = {"autoreset_mode": gym.vector.AutoresetMode.DISABLED}  # noqa: RUF012


class Fresh(Several):
    fresh_results = True


@pytest.mark.parametrize("make", [Single, Several, Fresh])
@pytest.mark.parametrize("placement", ["inline", "process"])
def test_every_result_has_the_type_that_the_placement_gives(make: Any, placement: str) -> None:
    """Those of resets, of steps, and those that show a restored state."""
    config = EnvConfig(name="t", task=make, placement=placement, num_workers=2)
    kind = Tensor if placement == "inline" else np.ndarray

    def check(batch: Any, steps: int) -> None:
        for value in batch.values():
            assert type(value.observation) is kind
            assert np.all(as_numpy(value.observation) == steps)
            assert np.all(value.last_reward == (0 if batch.is_reset.all() else steps))
            assert np.all(value.last_terminated == (steps == 3))
            assert not holds_tensor((value.last_reward, value.last_terminated, value.info))

    action = np.zeros((2, *make.head), int)
    with sync.build_env_group(config) as group:
        for _ in range(2):
            batch, _ = group.reset()
            check(batch, 0)
            for steps in (1, 2):
                batch, _ = group.step(batch.respond(action=action))
                check(batch, steps)
            saved = group.snapshot()
            batch, _ = group.step(batch.respond(action=action))
            check(batch, 3)
            batch, _ = group.restore(saved)
            assert batch.is_reset.all()
            check(batch, 2)
            batch, _ = group.step(batch.respond(action=action))
            check(batch, 3)
    with sync.build_env_group(config) as group:
        batch, _ = group.restore(saved)
        check(batch, 2)
        batch, _ = group.step(batch.respond(action=action))
        check(batch, 3)


class Failing(Several):
    """Raises in its second step."""

    def step(self, action: Any) -> Any:
        if self.steps:
            raise ValueError("lost its balance")
        return super().step(action)


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_an_env_of_tensors_that_is_rebuilt_says_why(placement: str) -> None:
    """Its first result is marked: the episode before is no failure of the policy."""
    config = EnvConfig(name="t", task=Failing, placement=placement, on_env_error="restart")
    with sync.build_env_group(config) as group:
        batch, _ = group.reset()
        for _ in range(2):
            batch, _ = group.step(batch.respond(action=np.zeros((1, 3), int)))
        assert batch.restarted.all()
        assert batch.truncated.all()
        (outcome,) = {*batch.outcome.ravel()}
        assert (outcome.kind, outcome.blame) == ("env_raised", "either")
        assert "lost its balance" in outcome.cause
        assert "lost its balance" in batch.info("worker_restarted")[0]
        assert batch["t-0"].last_truncated.all()
        assert batch["t-0"].info["outcome"] == outcome
        assert np.all(as_numpy(batch["t-0"].observation) == 0)
        counts = [n for name, n in group.metrics().items() if name.endswith("outcomes_env_raised")]
        assert counts == [3]


class Wavering(Several):
    """Returns tensors and arrays in turn."""

    def _observation(self) -> Any:
        found = super()._observation()
        return found if self.steps % 2 else found.array


def test_an_env_may_return_tensors_and_arrays() -> None:
    """Results that are handed out together come each as its env returned it."""
    config = EnvConfig(name="t", task=Wavering, placement="inline", num_workers=2)
    with sync.build_env_group(config) as group:
        batch, _ = group.reset()
        group.step_async(batch.take([1]).respond(action=np.zeros((1, 3), int)))
        batch, _ = group.collect_async()
        group.step_async(batch.respond(action=np.zeros((1, 3), int)))
        group.reset_async(env_ids=["t-0"])
        batch, _ = group.collect_async(wait_all=True)
        assert batch.observation.tolist() == [[[0, 0]] * 3, [[2, 2]] * 3]
        group.step_async(batch.take([1]).respond(action=np.zeros((1, 3), int)))
        group.reset_async(env_ids=["t-0"])
        batch, _ = group.collect_async(wait_all=True)
        assert [type(value.observation) for value in batch.values()] == [np.ndarray, Tensor]


class OneReward(Several):
    """Returns the reward of one sub-environment for three."""

    def step(self, action: Any) -> Any:
        return np.zeros((3, 2)), np.ones(1), np.zeros(3, bool), np.zeros(3, bool), {}


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_a_bare_result_is_checked_like_any_other(placement: str) -> None:
    """A reward that would have to be spread over the sub-environments is an error."""
    config = EnvConfig(name="t", task=OneReward, placement=placement)
    with sync.build_env_group(config) as group:
        batch, _ = group.reset()
        with pytest.raises(EnvRaised, match=r"reward of env 't-0' has shape \(1,\), expected"):
            group.step(batch.respond(action=np.zeros((1, 3), int)))
