"""`pettingzoo`: any parallel environment of PettingZoo, all its agents in each result.

Rule: every result covers every possible agent in the same order, so that a group can lay
them out once; an agent that has left counts as terminated or truncated.
Left out: turn-based (AEC) environments; PettingZoo converts those itself.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import did_you_mean
from rlightning_aio.trees import as_numpy, mapped, tree_of
from rlightning_aio.types import MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    import gymnasium as gym

    from rlightning_aio.config import EnvConfig

DEFAULT_FACTORY = "parallel_env"

# Partly typed, so imported by name.
pettingzoo: Any = import_module("pettingzoo")


class PettingZooEnv(BaseEnv):
    """One parallel environment; ``env_kwargs`` go to the function that makes it.

    ``task`` is a name of PettingZoo's registry (``sisl/pursuit-v5``), if need be with the module
    that registers it (``my_arenas:arena/duel-v0``); or ``module`` (``mpe2.simple_spread_v3``),
    whose ``parallel_env`` is called; or ``module:function`` for a function of another name.

    ``agents`` are the environment's possible agents, and its spaces are Dicts over them.
    An agent that has left before the episode's end keeps an observation of zeros, a reward of 0.0
    and the flags it left with (terminated, if it left with none); its action is ignored. So is that
    of an agent that hasn't joined yet, which is not terminated while any other is left. Infos are
    by agent, for agents that reported any.

    The config's ``max_episode_steps`` truncates the episode for all agents that are left.
    """

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.env = self._make()
        self.agents = tuple(self.env.possible_agents)
        self._observation_spaces = {a: self.env.observation_space(a) for a in self.agents}
        self._action_spaces = {a: self.env.action_space(a) for a in self.agents}
        if self.max_episode_steps is None:
            self.max_episode_steps = _own_limit(self.env.unwrapped)

    def _make(self) -> Any:
        module, _, name = self.config.task_name.rpartition(":")
        if all(part.isidentifier() for part in name.split(".")):
            return self._factory()(**self.config.env_kwargs)
        if module:
            import_module(module)
        self._check_registered(name)
        try:
            return pettingzoo.make("parallel", name, **self.config.env_kwargs)
        except pettingzoo.env_registry.exceptions.FailedToImport as error:
            raise ConfigError(f"env {self.env_id!r}: {error}") from error

    def _check_registered(self, name: str) -> None:
        try:
            pettingzoo.spec("parallel", name)
        except pettingzoo.env_registry.exceptions.PettingZooRegistryError as error:
            if name in pettingzoo.aec_registry:
                reason = "is turn-based; convert it in your own function (module:function)"
            else:
                known: list[str] = list(pettingzoo.parallel_registry)
                hint = did_you_mean(name, known)
                reason = f"is not registered; {hint}" if hint else "is not registered"
            raise ConfigError(f"env {self.env_id!r}: PettingZoo's {name!r} {reason}") from error

    def _factory(self) -> Any:
        module_name, _, function = self.config.task_name.partition(":")
        factory = getattr(import_module(module_name), function or DEFAULT_FACTORY, None)
        if factory is None:
            raise ConfigError(
                f"env {self.env_id!r}: module {module_name} has no function "
                f"{function or DEFAULT_FACTORY}; task names a module with a parallel_env, "
                "module:function, or an environment of PettingZoo's registry"
            )
        return factory

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> MultiAgentEnvRet:
        observations, infos = self.env.reset(seed=seed, options=options)
        self._steps = 0
        self._expected = set(self.agents) - set(observations)
        self._terminated = dict.fromkeys(self.agents, False)
        self._truncated = dict.fromkeys(self.agents, False)
        return self._result(observations, {}, infos)

    def step(self, policy_resp: PolicyResponse) -> MultiAgentEnvRet:
        live = list(self.env.agents)  # Some environments empty their list in place.
        if not live:
            raise RuntimeError(
                f"env {self.env_id!r} has no agents: reset it before its first step and after "
                "the end of each episode"
            )
        actions = as_numpy(self._preprocess_fn(policy_resp))
        observations, rewards, terminated, truncated, infos = self.env.step(
            {agent: actions[agent] for agent in live}
        )
        self._note_flags(live, terminated, truncated)
        return self._result(observations, rewards, infos)

    def _note_flags(
        self, live: list[str], terminated: dict[str, bool], truncated: dict[str, bool]
    ) -> None:
        """Update the agents' flags; `live` took part before the step."""
        there = self.env.agents
        self._expected -= {*there, *terminated, *truncated}
        for agent in {*live, *there}:
            self._terminated[agent] = bool(terminated.get(agent, False))
            self._truncated[agent] = bool(truncated.get(agent, False))
        for agent in set(live) - set(there):
            # An agent that left has ended, even if the simulator forgot to say so.
            self._terminated[agent] |= not self._truncated[agent]
        if not there:  # No agent waits for those that are expected.
            self._terminated |= dict.fromkeys(self._expected, True)
        self._steps += 1
        if self._steps >= (self.config.max_episode_steps or math.inf):
            self._truncated |= dict.fromkeys([*there, *self._expected], True)

    def _result(
        self, observations: dict[str, Any], rewards: dict[str, Any], infos: dict[str, Any]
    ) -> MultiAgentEnvRet:
        return MultiAgentEnvRet(
            env_id=self.env_id,
            observation={
                agent: observations[agent] if agent in observations else _zeros(space)
                for agent, space in self._observation_spaces.items()
            },
            last_reward={agent: float(rewards.get(agent, 0.0)) for agent in self.agents},
            last_terminated=dict(self._terminated),
            last_truncated=dict(self._truncated),
            info={agent: info for agent, info in infos.items() if info},
        )

    def get_observation_space(self) -> Dict:
        return Dict(self._observation_spaces)

    def get_action_space(self) -> Dict:
        return Dict(self._action_spaces)

    def close(self) -> None:
        self.env.close()


def _own_limit(simulator: Any) -> int | None:
    """Return the simulator's step limit, if it has one."""
    # PettingZoo's SISL envs keep it in an inner object.
    limits = (
        getattr(one, "max_cycles", None) for one in (simulator, getattr(simulator, "env", None))
    )
    return next((limit for limit in limits if limit is not None), None)


def _zeros(space: gym.Space[Any]) -> Any:
    """Return the member of `space` that is nearest to zero."""
    return mapped(_zero, tree_of(space))


def _zero(space: gym.Space[Any]) -> Any:
    known = cast("Any", space)  # Gymnasium's spaces are generic over a dtype that is left out.
    if isinstance(space, Discrete):
        return known.start
    zeros = np.zeros(space.shape or (), known.dtype)
    return np.clip(zeros, known.low, known.high) if isinstance(space, Box) else zeros
