"""Envs written for RLightning."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rlightning_aio.legacy import install

install()

from rlightning.env.base_env import BaseEnv  # noqa: E402
from rlightning.types import EnvMeta, EnvRet  # noqa: E402
from rlightning.utils.registry import ENVS  # noqa: E402


@dataclass
class RichRet(EnvRet):
    """A result with a field of its own."""

    belief: list[Any] = field(default_factory=list[Any])


@ENVS.register("counting")
class CountingEnv(BaseEnv):
    """Counts its steps in its observation; `reset` takes any of RLightning's arguments."""

    def __init__(self, config: Any, worker_index: int = 0, preprocess_fn: Any = None) -> None:
        super().__init__(config, worker_index, preprocess_fn)
        self.index = worker_index
        self.given: Any = None
        self.seen: Any = None
        self.rollouts = 0
        self.evaluates = False
        self.count = 0

    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *args: Any, **kwargs: Any) -> EnvRet:
        self.given, self.count = (args, kwargs), 0
        return EnvRet(env_id=self.env_id, observation=np.array([self.index, 0.0]))

    def step(self, policy_resp: Any) -> EnvRet:
        self.seen = policy_resp
        self.count += 1
        observation = np.array([self.index, float(self.count)])
        if getattr(policy_resp, "wants", None) == "everything":
            return RichRet(self.env_id, "a text", 2.0, _extra={"v": 1}, belief=[{1, 2}])
        if getattr(policy_resp, "wants", None) == "an error":
            raise RuntimeError("as asked")
        if getattr(policy_resp, "wants", None) == "an end":
            os.kill(os.getpid(), signal.SIGKILL)
        info = {"episode_info": {"length": self.count}} if self.count == 2 else {}
        return EnvRet(self.env_id, observation, float(self.count), self.count == 2, info=info)

    def apply_evaluate_cfg(self) -> None:
        self.evaluates = True

    def restore_evaluate_cfg(self) -> None:
        self.evaluates = False

    def finish_rollout(self) -> None:
        self.rollouts += 1


@ENVS.register("failing")
class FailingEnv(CountingEnv):
    """Raises in a reset if it is asked to."""

    def reset(self, fails: int | None = None) -> EnvRet:
        if fails == self.index:
            raise RuntimeError("as asked")
        return super().reset()


@ENVS.register("arm")
class Arm(CountingEnv):
    """Writes to a file when it is stopped and closed."""

    hardware = True

    def _note(self, what: str) -> None:
        with Path(self.config.env_kwargs.log).open("a") as file:
            file.write(f"{what}\n")

    def on_disconnect(self) -> None:
        self._note("stop")

    def close(self) -> None:
        self._note("close")


@ENVS.register("plain_reset")
class PlainResetEnv(CountingEnv):
    """Two sub-environments, a `reset` without arguments, and no spaces before `init`."""

    def get_observation_space(self) -> Any:
        return None

    def get_action_space(self) -> Any:
        return self.env.action_space

    def init(self) -> EnvMeta:
        return EnvMeta(env_id=self.env_id, num_envs=self.num_envs)

    def reset(self) -> EnvRet:
        return EnvRet(self.env_id, {"texts": ["first"]})

    def step(self, policy_resp: Any) -> EnvRet:
        return super().step(self._preprocess_fn(policy_resp))
