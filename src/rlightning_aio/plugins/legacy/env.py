"""RLightning's `BaseEnv`, and its built-in envs on our backends."""

from __future__ import annotations

import abc
import copy
import uuid
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio import ENVS as BACKENDS
from rlightning_aio import EnvConfig
from rlightning_aio import PolicyResponse as Response
from rlightning_aio.plugins.legacy.registry import ENVS
from rlightning_aio.plugins.legacy.types import EnvMeta, EnvRet
from rlightning_aio.types import default_env_preprocess_fn

if TYPE_CHECKING:
    from collections.abc import Callable

    import gymnasium as gym


class BaseEnv(abc.ABC):
    """An env of RLightning's kind. Subclasses set ``self.env`` and define `reset` and `step`.

    Attributes:
        config: a deep copy of the entry.
        env_id: ``<uuid>-<worker_index>``.
        env: the simulator.
        num_envs, max_episode_steps: the entry's.
    """

    def __init__(
        self,
        config: Any,
        worker_index: int | None = 0,
        preprocess_fn: Callable[[Any], Any] | None = None,
    ) -> None:
        self.config = copy.deepcopy(config)
        self.env_id = f"{uuid.uuid4()}-{worker_index}"
        self.env: Any = None
        self.num_envs: int = self.config.num_envs
        self.max_episode_steps: int | None = self.config.max_episode_steps
        self._preprocess_fn: Any = preprocess_fn
        self._episode_env_infos: dict[str, list[Any]] = defaultdict(list)

    @abc.abstractmethod
    def reset(self, *args: Any, **kwargs: Any) -> Any:
        """Start an episode with the arguments of the group's `reset`. Return an `EnvRet`."""

    @abc.abstractmethod
    def step(self, policy_resp: Any) -> Any:
        """Advance by one step. Return an `EnvRet`."""

    def get_env_id(self) -> str:
        """Return the env's id."""
        return self.env_id

    def get_observation_space(self) -> gym.Space[Any]:
        """Return the simulator's space; override it if observations differ."""
        return self.env.observation_space

    def get_action_space(self) -> gym.Space[Any]:
        """Return the simulator's space."""
        return self.env.action_space

    def get_max_episode_steps(self) -> int | None:
        """Return the step limit for `EnvGroup.auto_reset`."""
        return self.max_episode_steps

    def init(self) -> Any:
        """Return the metadata; `EnvGroup.init` calls it and returns the values."""
        return EnvMeta(
            env_id=self.env_id,
            action_space=self.get_action_space(),
            observation_space=self.get_observation_space(),
            num_envs=self.num_envs,
        )

    # -- reset and step with what is recorded of them, which a group calls

    def _reset(self, *args: Any, **kwargs: Any) -> Any:
        return self._recorded(self.reset(*args, **kwargs))

    def _step(self, policy_resp: Any) -> Any:
        return self._recorded(self.step(policy_resp))

    def _recorded(self, env_ret: EnvRet) -> EnvRet:
        for name, value in env_ret.info.get("episode_info", {}).items():
            self._episode_env_infos[name].append(value)
        return env_ret

    def get_env_stats(self, reset: bool = False) -> dict[str, list[float]]:
        """Return sum and count of each metric in ``info["episode_info"]`` since `reset`."""
        stats: dict[str, list[float]] = {}
        for name, values in self._episode_env_infos.items():
            flat = [np.asarray(value.cpu() if hasattr(value, "cpu") else value) for value in values]
            stats[name] = [sum(float(a.sum()) for a in flat), sum(a.size for a in flat)]
        if reset:
            self._episode_env_infos.clear()
        return stats

    # -- methods that a subclass may define

    def is_finish(self) -> bool:
        """Return True to end `RemoteEnvClient.run`; called after every step."""
        return False

    def close(self) -> None:
        """Release everything."""

    def offload(self) -> None:
        """Free device memory."""

    def reload(self) -> None:
        """Allocate the memory again."""

    def apply_evaluate_cfg(self) -> None:
        """Apply ``config.evaluate_cfg``, if this env knows it."""

    def restore_evaluate_cfg(self) -> None:
        """Undo `apply_evaluate_cfg`."""

    def finish_rollout(self) -> None:
        """Finish a rollout; `EnvGroup.get_env_stats` calls it."""


class SimulatedEnv(BaseEnv):
    """An env of one of our backends: of the one that the entry names.

    Attributes:
        native: the backend's own env, whose simulator is ``self.env``.
        trainer_pid: the trainer's process, which a robot's watchdog looks at.
    """

    trainer_pid: int | None = None

    def __init__(
        self,
        config: Any,
        worker_index: int | None = 0,
        preprocess_fn: Callable[[Any], Any] | None = default_env_preprocess_fn,
        **kwargs: Any,
    ) -> None:
        del kwargs  # Accepted so that subclasses can pass on all their arguments.
        super().__init__(config, worker_index, preprocess_fn)
        native = EnvConfig(
            name=config.name,
            backend=config.backend,
            task=config.task,
            num_envs=config.num_envs,
            max_episode_steps=config.max_episode_steps,
            env_kwargs=config.env_kwargs.to_dict(),
        )
        self.native = BACKENDS.resolve(config.backend)(native, worker_index or 0)
        self.env = self.native.env
        self.observation_space: Any = self.native.get_observation_space()
        self.action_space: Any = self.native.get_action_space()

    def get_observation_space(self) -> gym.Space[Any]:
        return self.observation_space

    def get_action_space(self) -> gym.Space[Any]:
        return self.action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None, **kwargs: Any
    ) -> EnvRet:
        del kwargs  # RLightning's envs accept each other's arguments.
        self.native.trainer_pid = self.trainer_pid
        result = self.native.reset(seed=seed, options=options)
        return EnvRet(self.env_id, result.observation, info=result.info)

    def step(self, policy_resp: Any) -> EnvRet:
        result = self.native.step(Response(self.env_id, self._preprocess_fn(policy_resp)))
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

    def stop(self) -> None:
        """Stop what moves; called of hardware only."""
        self.native.stop()

    def close(self) -> None:
        self.native.close()


MujocoEnv = ALEEnv = SimulatedEnv
for _backend in ("mujoco", "ale", "maniskill", "isaac_manager_based", "isaac_marl", "piper"):
    ENVS.provide(_backend, SimulatedEnv)
