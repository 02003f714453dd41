"""`isaac_manager_based` and `isaac_marl`: tasks of Isaac Lab, batched on one device.

Rule: the simulator's tensors stay tensors on their device, and results are copies, because
Isaac Lab reuses its buffers. `isaac_task` launches Isaac Lab 3 or 2.3 and builds the task.
Left out: more than one live env in a process, which the simulator does not support.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.envs.simulators.isaac_task import make_simulator
from rlightning_aio.errors import ConfigError
from rlightning_aio.trees import mapped
from rlightning_aio.types import EnvRet, MultiAgentEnvRet

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.types import PolicyResponse


class _IsaacEnv(BaseEnv):
    """Both backends: what differs is whether the task has agents, and then all is by agent.

    Sub-environments that finish are reset by the simulator within the same step, so the
    observation that comes with ``last_terminated`` or ``last_truncated`` is already the
    next episode's; the final one is in ``info["final_obs"]``, where the simulator
    computes it (Isaac Lab 3). ``info["episode_info"]`` holds the simulator's log of the
    episodes that ended in that step.
    """

    autoreset = "same_step"
    default_env_class: ClassVar[str | None] = None
    live_env_id: ClassVar[str | None] = None

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self._fresh = True
        self._claim_process()
        try:
            self.env = make_simulator(
                self.env_id, self.config, self.default_env_class, self.worker_index
            )
        except BaseException:
            _IsaacEnv.live_env_id = None
            raise
        self._torch: Any = importlib.import_module("torch")
        self.max_episode_steps = int(self.env.max_episode_length)
        self.agents = tuple(getattr(self.env, "possible_agents", ()))

    def _claim_process(self) -> None:
        if (other := _IsaacEnv.live_env_id) is not None:
            raise ConfigError(
                f"{self.env_id}: Isaac Lab allows one live env in a process, and {other} lives in "
                "this one; set envs_per_process: 1, or raise num_envs instead"
            )
        _IsaacEnv.live_env_id = self.env_id

    def _single_spaces(self, what: str) -> Any:
        """The space of one sub-environment's observations or actions, or such by agent."""
        return getattr(self.env, f"{what}_spaces" if self.agents else f"single_{what}_space")

    def _batched(self, what: str) -> gym.Space[Any]:
        spaces = self._single_spaces(what)
        if self.agents:
            spaces = gym.spaces.Dict({agent: spaces[agent] for agent in self.agents})
        return spaces if self.num_envs == 1 else batch_space(spaces, self.num_envs)

    def get_observation_space(self) -> gym.Space[Any]:
        return self._batched("observation")

    def get_action_space(self) -> gym.Space[Any]:
        return self._batched("action")

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        """Reset every sub-environment; the simulator has one generator for all of them."""
        first_seed = seed[0] if isinstance(seed, list) else seed
        if self._fresh:
            # The first reset after construction reports the velocities from before it.
            self.env.reset(seed=first_seed, options=options)
            self._fresh = False
        observation, extras = self.env.reset(seed=first_seed, options=options)
        return self._result(observation, self._log(extras) | self._by_agent(extras))

    def step(self, policy_resp: PolicyResponse) -> EnvRet | MultiAgentEnvRet:
        given, spaces = self._preprocess_fn(policy_resp), self._single_spaces("action")
        if self.agents:
            actions = {agent: self._tensor(given[agent], spaces[agent]) for agent in self.agents}
        else:
            actions = self._tensor(given, spaces)
        observation, reward, terminated, truncated, extras = self.env.step(actions)
        return self._result(
            observation,
            self._ended(extras) | self._by_agent(extras),
            last_reward=mapped(self._scalar_or_own, reward),
            last_terminated=mapped(self._scalar_or_own, terminated),
            last_truncated=mapped(self._scalar_or_own, truncated),
        )

    def _result(
        self, observation: Any, info: dict[str, Any], **step: Any
    ) -> EnvRet | MultiAgentEnvRet:
        kind = MultiAgentEnvRet if self.agents else EnvRet
        return kind(env_id=self.env_id, observation=self._own(observation), info=info, **step)

    def _tensor(self, action: Any, space: gym.Space[Any]) -> Any:
        """Convert an action to ``[num_envs, ...]`` on the simulation device."""
        torch = self._torch
        discrete = isinstance(space, gym.spaces.Discrete)
        dtype = torch.float32 if isinstance(space, gym.spaces.Box) else torch.int64
        if isinstance(action, torch.Tensor):
            tensor = action.to(device=self.env.device, dtype=dtype)
        else:
            # A copy, because the simulator may keep it longer than the caller keeps the array.
            tensor = torch.tensor(action, device=self.env.device, dtype=dtype)
        return tensor.reshape(self.num_envs, *((1,) if discrete else space.shape or ()))

    def _own(self, value: Any) -> Any:
        """Copy nested tensors, without the batch axis if there is one sub-environment."""
        alone = self.num_envs == 1
        return mapped(lambda tensor: tensor[0].clone() if alone else tensor.clone(), value)

    def _scalar_or_own(self, value: Any) -> Any:
        return value[0].item() if self.num_envs == 1 else value.clone()

    def _log(self, extras: Mapping[str, Any]) -> dict[str, Any]:
        return {"episode_info": dict(extras["log"])} if "log" in extras else {}

    def _by_agent(self, extras: Mapping[str, Any]) -> dict[str, Any]:
        info: dict[str, Any] = {}
        for agent in self.agents:
            if kept := {k: v for k, v in extras[agent].items() if k != "final_obs"}:
                info[agent] = kept
        return info

    def _final_obs(self, extras: Mapping[str, Any]) -> Any:
        """Return the observations before the resets of this step, or None if not computed."""
        if not self.agents:
            return extras.get("final_obs")
        found = {agent: extras[agent].get("final_obs") for agent in self.agents}
        return None if None in found.values() else found

    def _ended(self, extras: Mapping[str, Any]) -> dict[str, Any]:
        """Return info about the episodes that ended in this step.

        The simulator keeps the last log and final observation, so they are valid only in a
        step that reset something.
        """
        if not bool(self.env.reset_buf.any()):
            return {}
        info = self._log(extras)
        if (final_obs := self._final_obs(extras)) is not None:
            info["final_obs"] = self._own(final_obs)
        return info

    def close(self) -> None:
        if self.env is None:
            return
        try:
            self.env.close()
        finally:
            self.env = None
            _IsaacEnv.live_env_id = None


class IsaacManagerBasedEnv(_IsaacEnv):
    """A manager-based task (``ManagerBasedRLEnv``), single-agent.

    Observations are a dict of ``[num_envs, *obs]`` float32 tensors by observation group;
    rewards ``[num_envs]`` float32; flags ``[num_envs]`` bool. With ``num_envs: 1`` the
    batch axis is left out and reward and flags are Python scalars.
    """

    default_env_class: ClassVar[str | None] = "isaaclab.envs::ManagerBasedRLEnv"


class IsaacMarlEnv(_IsaacEnv):
    """A direct multi-agent task (``DirectMARLEnv``).

    Actions, and every field of a result but the info, are dicts by agent; each value is as in
    `IsaacManagerBasedEnv`. ``info["final_obs"]`` is by agent, and ``info[agent]`` holds the
    task's own report for that agent.
    """
