"""What an env offers to save time comes with the mixin, and not without it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.envs.base import result_of
from rlightning_aio.envs.fast_path import FastPath


@rl.ENVS.register("doubling")
class Doubling(rl.BaseEnv):
    """Shows twice the action."""

    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-9, 9, (1,))

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-4, 4, (1,))

    def reset(self, *, seed: Any = None, options: Any = None) -> rl.EnvRet:
        return rl.EnvRet(env_id=self.env_id, observation=np.zeros(1, np.float32))

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        return result_of(self.env_id, self._doubled(self._preprocess_fn(policy_resp)))

    def _doubled(self, action: Any) -> Any:
        return action * 2, 1.0, False, False, {"bare": 0}


@rl.ENVS.register("bare")
class Bare(FastPath, Doubling):
    """Likewise; what its bare step returns can be told apart."""

    def bare_step(self) -> Any:
        return lambda action: (*self._doubled(action)[:-1], {"bare": 1})


@rl.ENVS.register("mixed")
class Mixed(Doubling):
    """Forgets the mixin."""

    def bare_step(self) -> Any:
        return self._doubled


@pytest.mark.parametrize(("backend", "is_bare"), [("doubling", 0), ("bare", 1)])
def test_a_bare_step_is_used_where_a_class_has_the_mixin(backend: str, is_bare: int) -> None:
    """An env without it offers nothing."""
    with sync.build_env_group(backend=backend, task="-", name="one", placement="inline") as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=[[1.5]]))
        assert batch.observation.tolist() == [[3.0]]
        assert batch.info("bare").tolist() == [is_bare]


def test_a_bare_step_without_the_mixin_is_refused() -> None:
    """It would be ignored, and the env slower than its author expects."""
    group = sync.build_env_group(backend="mixed", task="-", name="one", placement="inline")
    with pytest.raises(rl.StartFailed, match="FastPath"):
        group.init()
