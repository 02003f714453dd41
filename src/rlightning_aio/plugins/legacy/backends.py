"""RLightning's built-in envs, on rlightning_aio's own backends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from rlightning_aio import ENVS as BACKENDS
from rlightning_aio import EnvConfig
from rlightning_aio import PolicyResponse as Response
from rlightning_aio.plugins.legacy.config import Config
from rlightning_aio.plugins.legacy.env import BaseEnv, default_env_preprocess_fn
from rlightning_aio.plugins.legacy.registry import ENVS
from rlightning_aio.plugins.legacy.types import EnvRet

if TYPE_CHECKING:
    from collections.abc import Callable

    import gymnasium as gym

__all__ = [
    "ALEEnv",
    "IsaacEnv",
    "IsaacMarlEnv",
    "ManiskillEnv",
    "MujocoEnv",
    "PiperEnv",
]


class _SimulatedEnv(BaseEnv):
    """An env of one of our backends.

    Attributes:
        native: the backend's own env, whose simulator is ``self.env``.
    """

    backend: ClassVar[str]

    def __init__(
        self,
        config: Any,
        worker_index: int | None = 0,
        preprocess_fn: Callable[[Any], Any] | None = default_env_preprocess_fn,
        **kwargs: Any,
    ) -> None:
        del kwargs  # Accepted so that subclasses can pass on all their arguments.
        super().__init__(config, worker_index, preprocess_fn)
        arguments = self._arguments()
        # `init_params` are all of ManiSkill's own arguments, including these two.
        task = arguments.pop("id", config.task)
        num_envs = arguments.pop("num_envs", config.num_envs)
        native = EnvConfig(
            name=config.name,
            backend=self.backend,
            task=task,
            num_envs=num_envs,
            max_episode_steps=config.max_episode_steps,
            env_kwargs=arguments,
        )
        self.native = BACKENDS.resolve(self.backend)(native, worker_index or 0)
        self.env = self.native.env
        self.observation_space: Any = self.native.get_observation_space()
        self.action_space: Any = self.native.get_action_space()

    def _arguments(self) -> dict[str, Any]:
        """Return the simulator's arguments: ``env_kwargs``, updated by ``init_params``."""
        sections = (self.config.env_kwargs, self.config.get("init_params"))
        return {
            name: value
            for section in sections
            if isinstance(section, Config)
            for name, value in section.to_dict().items()
        }

    def get_observation_space(self) -> gym.Space[Any]:
        return self.observation_space

    def get_action_space(self) -> gym.Space[Any]:
        return self.action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None, **kwargs: Any
    ) -> EnvRet:
        del kwargs  # RLightning's envs accept each other's arguments.
        result = self.native.reset(seed=seed, options=options)
        return EnvRet(self.env_id, result.observation, info=result.info)

    def step(self, policy_resp: Any) -> EnvRet:
        action = self._preprocess_fn(policy_resp)
        result = self.native.step(Response(self.env_id, action))
        return EnvRet(
            self.env_id,
            result.observation,
            result.last_reward,
            result.last_terminated,
            result.last_truncated,
            result.info,
        )

    def offload(self) -> None:
        self.native.offload()

    def reload(self) -> None:
        self.native.reload()

    def is_finish(self) -> bool:
        return self.native.is_finish()

    def close(self) -> None:
        self.native.close()


class _GymnasiumEnv(_SimulatedEnv):
    """A Gymnasium env that is made from its task alone."""

    def _arguments(self) -> dict[str, Any]:
        return {}

    def reset(self, *args: Any, **kwargs: Any) -> EnvRet:
        observation, info = self.env.reset(*args, **kwargs)
        return EnvRet(self.env_id, observation, info=info)

    def step(self, policy_resp: Any) -> EnvRet:
        return EnvRet(self.env_id, *self.env.step(np.asarray(self._preprocess_fn(policy_resp))))

    def offload(self) -> None:
        """Do nothing: it holds no device memory."""

    def reload(self) -> None:
        """Do nothing: it has freed no memory."""


class MujocoEnv(_GymnasiumEnv):
    """Gymnasium's MuJoCo tasks."""

    backend = "mujoco"


class ALEEnv(_GymnasiumEnv):
    """Atari games, with raw frames."""

    backend = "ale"


class ManiskillEnv(_SimulatedEnv):
    """ManiSkill's tasks, with the observations of the task itself."""

    backend = "maniskill"


class IsaacEnv(_SimulatedEnv):
    """Isaac Lab's manager-based tasks."""

    backend = "isaac_manager_based"


class IsaacMarlEnv(_SimulatedEnv):
    """Isaac Lab's multi-agent tasks."""

    backend = "isaac_marl"


class PiperEnv(_SimulatedEnv):
    """A Piper arm."""

    backend = "piper"


_BUILT_IN: Final = (MujocoEnv, ALEEnv, ManiskillEnv, IsaacEnv, IsaacMarlEnv, PiperEnv)
for _kind in _BUILT_IN:
    ENVS.provide(_kind.backend, _kind)
