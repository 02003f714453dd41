"""Envs that use their arrays again, and whose infos have keys that are ours."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from rlightning_aio.vector import VectorEnv

LAST = 2


class Reusing(gym.Env[Any, int]):
    """Returns the same arrays and infos each time."""

    observation_space: Any = gym.spaces.Dict({"a": gym.spaces.Box(-9, 9, (1,), np.float32)})
    action_space: Any = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self.observation = {"a": np.zeros(1, np.float32)}
        self.info: dict[str, Any] = {"at": np.zeros(1), "deep": {"list": [0]}}

    def _at(self, step: int) -> Any:
        self.step_number = step
        self.observation["a"][:] = self.info["at"][:] = self.info["deep"]["list"][0] = step
        return self.observation, self.info

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        del options
        observation, info = self._at(0)
        return observation, {**info, "final_obs": "the env's own", "final_info": "likewise"}

    def step(self, action: int) -> Any:
        del action
        observation, info = self._at(self.step_number + 1)
        return observation, 0.0, self.step_number == LAST, False, info


@pytest.mark.parametrize("fields", [{}, {"placement": "inline"}], ids=["worker", "inline"])
def test_what_is_final_is_that_of_the_episode_that_has_ended(fields: dict[str, Any]) -> None:
    envs = VectorEnv([Reusing, Reusing], autoreset_mode=AutoresetMode.SAME_STEP, **fields)
    envs.reset()
    for _ in range(LAST):
        observation, _, terminated, _, infos = envs.step(np.zeros(2, np.int64))
    assert terminated.all()
    assert observation["a"].tolist() == [[0.0], [0.0]]
    for k in range(2):
        assert infos["final_obs"][k]["a"].tolist() == [LAST]
    assert infos["final_info"]["at"].tolist() == [[LAST], [LAST]]
    assert list(infos["final_info"]["deep"]["list"]) == [[LAST], [LAST]]
    assert infos["at"].tolist() == [[0], [0]]
    envs.close()
