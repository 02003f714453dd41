"""RLightning's `BaseEnv`, and what it steps with by default."""

from __future__ import annotations

import abc
import copy
import logging
import uuid
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.legacy.flags import InternalFlag
from rlightning_aio.legacy.types import EnvMeta, EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable

    import gymnasium as gym

__all__ = ["BaseEnv", "default_env_preprocess_fn"]


def default_env_preprocess_fn(policy_resp: PolicyResponse) -> Any:
    """The action as the policy gave it."""
    return policy_resp.action


class BaseEnv(abc.ABC):
    """One env of RLightning's kind. Subclasses set ``self.env`` and define `reset` and `step`.

    Attributes:
        config: a deep copy of the entry.
        env_id: ``<uuid>-<worker_index>``.
        env: the simulator.
        num_envs, max_episode_steps: the entry's.
        timing_raw: what `profiler.timer_wrap` measured.
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
        """Start a new episode with whatever the group's `reset` was given; an `EnvRet`."""

    @abc.abstractmethod
    def step(self, policy_resp: Any) -> Any:
        """Advance by one step; an `EnvRet`."""

    def get_env_id(self) -> str:
        """Its id."""
        return self.env_id

    def get_observation_space(self) -> gym.Space[Any]:
        """The simulator's; override it where observations are something else."""
        return self.env.observation_space

    def get_action_space(self) -> gym.Space[Any]:
        """The simulator's."""
        return self.env.action_space

    def get_max_episode_steps(self) -> int | None:
        """The step limit that `EnvGroup.auto_reset` takes."""
        return self.max_episode_steps

    def get_metadata(self) -> EnvMeta:
        """Id, spaces and number of sub-environments."""
        return EnvMeta(
            env_id=self.env_id,
            action_space=self.get_action_space(),
            observation_space=self.get_observation_space(),
            num_envs=self.num_envs,
        )

    def init(self) -> Any:
        """Called by `EnvGroup.init`, which returns what this does."""
        return self.get_metadata()

    def step_async(self, policy_resp_list: Any) -> None:
        """For a server of remote envs alone."""
        raise NotImplementedError("step_async() belongs to RemoteEnvServer")

    def collect_async(self) -> Any:
        """For a server of remote envs alone."""
        raise NotImplementedError("collect_async() belongs to RemoteEnvServer")

    # -- what a group calls: reset and step, with the hooks around them

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
        """Sum and count of each metric in ``info["episode_info"]`` since the last `reset`."""
        stats: dict[str, list[float]] = {}
        for name, values in self._episode_env_infos.items():
            flat = [np.asarray(value.cpu() if hasattr(value, "cpu") else value) for value in values]
            stats[name] = [sum(float(a.sum()) for a in flat), sum(a.size for a in flat)]
        if reset:
            self._episode_env_infos.clear()
        return stats

    def print_timing_summary(self, reset: bool = False) -> None:
        """Log what `profiler.timer_wrap` measured."""
        for name, stats in self.timing_raw.items():
            logging.getLogger(__name__).debug("env %s, %s: %s", self.env_id, name, stats)
        if reset:
            self.timing_raw = {}

    # -- what a subclass may define

    def is_finish(self) -> bool:
        """Whether `RemoteEnvClient.run` should end; asked after every step."""
        return False

    def close(self) -> None:
        """Release everything."""

    def offload(self) -> None:
        """Free device memory."""

    def reload(self) -> None:
        """Take the memory again."""

    def apply_evaluate_cfg(self) -> None:
        """Take on ``config.evaluate_cfg``."""

    def restore_evaluate_cfg(self) -> None:
        """Drop what `apply_evaluate_cfg` took on."""

    def finish_rollout(self) -> None:
        """Called after each `EnvGroup.get_env_stats`."""
