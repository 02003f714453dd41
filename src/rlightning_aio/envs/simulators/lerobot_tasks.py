"""`pusht` and `aloha`: the simulated tasks of LeRobot that are Gymnasium environments."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.envs.simulators.switching import SwitchingEnv

__all__ = ["AlohaEnv", "PushTEnv"]


class _LeRobotEnv(GymnasiumEnv):
    """A task of one package, whose tasks share envs if they have the same spaces.

    ``env_kwargs`` go to `gymnasium.make`; the step limit is the config's, or the registered one.
    """

    package: ClassVar[str]

    def _make(self) -> Any:
        importlib.import_module(self.package)
        make = partial(_made, self.package, self.config.env_kwargs)
        env = SwitchingEnv(make, self.config.task_name)
        limit = (
            self.config.max_episode_steps
            or gym.spec(f"{self.package}/{env.task}").max_episode_steps
        )
        self.max_episode_steps = limit
        return env if limit is None else TimeLimit(env, limit)


def _made(package: str, env_kwargs: dict[str, Any], task: str) -> gym.Env[Any, Any]:
    # The limit is kept outside, for all tasks.
    return gym.make(f"{package}/{task}", disable_env_checker=True, **env_kwargs).unwrapped


class PushTEnv(_LeRobotEnv):
    """``PushT-v0``: push a block onto its goal."""

    package = "gym_pusht"


class AlohaEnv(_LeRobotEnv):
    """``AlohaInsertion-v0``, ``AlohaTransferCube-v0``: two arms, by MuJoCo."""

    package = "gym_aloha"
