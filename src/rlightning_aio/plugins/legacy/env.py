"""RLightning's `BaseEnv` and its default preprocess function."""

from __future__ import annotations

import abc
import copy
import logging
import uuid
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.plugins.legacy.flags import InternalFlag
from rlightning_aio.plugins.legacy.types import EnvMeta, EnvRet
from rlightning_aio.types import default_env_preprocess_fn

if TYPE_CHECKING:
    from collections.abc import Callable

    import gymnasium as gym

__all__ = ["BaseEnv", "default_env_preprocess_fn"]


class BaseEnv(abc.ABC):
    """An env of RLightning's kind. Subclasses set ``self.env`` and define `reset` and `step`.

    Attributes:
        config: a deep copy of the entry.
        env_id: ``<uuid>-<worker_index>``.
        env: the simulator.
        num_envs, max_episode_steps: the entry's.
        timing_raw: the durations that `profiler.timer_wrap` measured.
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
        self.timing_raw: dict[str, dict[str, Any]] = {}

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

    def get_metadata(self) -> EnvMeta:
        """Return the id, the spaces and the number of sub-environments."""
        return EnvMeta(
            env_id=self.env_id,
            action_space=self.get_action_space(),
            observation_space=self.get_observation_space(),
            num_envs=self.num_envs,
        )

    def init(self) -> Any:
        """Return the metadata; `EnvGroup.init` calls it and returns the values."""
        return self.get_metadata()

    def step_async(self, policy_resp_list: Any) -> None:
        """Raise an error: only a server of remote envs has it."""
        raise NotImplementedError("step_async() belongs to RemoteEnvServer")

    def collect_async(self) -> Any:
        """Raise an error: only a server of remote envs has it."""
        raise NotImplementedError("collect_async() belongs to RemoteEnvServer")

    # -- reset and step with the hooks around them, which a group calls

    def _reset(self, *args: Any, **kwargs: Any) -> Any:
        return self._post_step_hook(self.reset(*args, **kwargs))

    def _step(self, policy_resp: Any) -> Any:
        return self._post_step_hook(self.step(self._pre_step_hook(policy_resp)))

    def _pre_step_hook(self, policy_resp: Any) -> Any:
        return policy_resp.cpu()

    def _post_step_hook(self, env_ret: Any) -> Any:
        self._record_episode_info(env_ret)
        if InternalFlag.REMOTE_STORAGE:
            env_ret = env_ret.numpy()
        env_ret.mark_env_sent()
        return env_ret

    def _record_episode_info(self, env_ret: EnvRet) -> None:
        for name, value in env_ret.info.get("episode_info", {}).items():
            self._episode_env_infos[name].append(value)

    def get_env_stats(self, reset: bool = False) -> dict[str, list[float]]:
        """Return sum and count of each metric in ``info["episode_info"]`` since `reset`."""
        stats: dict[str, list[float]] = {}
        for name, values in self._episode_env_infos.items():
            flat = [np.asarray(value.cpu() if hasattr(value, "cpu") else value) for value in values]
            stats[name] = [sum(float(a.sum()) for a in flat), sum(a.size for a in flat)]
        if reset:
            self._episode_env_infos.clear()
        return stats

    def print_timing_summary(self, reset: bool = False) -> None:
        """Log the durations that `profiler.timer_wrap` measured."""
        for name, stats in self.timing_raw.items():
            logging.getLogger(__name__).debug("env %s, %s: %s", self.env_id, name, stats)
        if reset:
            self.timing_raw = {}

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
        """Apply ``config.evaluate_cfg``."""

    def restore_evaluate_cfg(self) -> None:
        """Undo `apply_evaluate_cfg`."""

    def finish_rollout(self) -> None:
        """Finish a rollout; `EnvGroup.get_env_stats` calls it."""
