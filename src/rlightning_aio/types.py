"""The values that cross the public interface one env at a time.

Rule: these are for people; the hot path moves columns (see `batch`) and makes one
of these only when somebody asks for it.
Absent on purpose: anything that knows where an env runs.
"""

from __future__ import annotations

import time
from typing import Any, Literal, NamedTuple, TypeAlias

import gymnasium as gym
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

__all__ = ["Autoreset", "ClientTraits", "EnvMeta", "EnvRet", "MultiAgentEnvRet", "PolicyResponse"]

Autoreset: TypeAlias = Literal["disabled", "next_step", "same_step"]
"""See `EnvMeta`."""


class PolicyResponse:
    """What a policy answers for one env: an action, and whatever it attaches.

    Args:
        env_id: the env that the action is for.
        action: fits the env's action space, unless a preprocess function or the env
            itself transforms it.
        extras: further fields (``log_prob``, ``value``, …), readable as attributes by
            the preprocess function and by the env's `step`.
    """

    def __init__(self, env_id: str, action: Any = None, **extras: Any) -> None:
        self.env_id = env_id
        self.action = action
        self.__dict__.update(extras)

    @property
    def extras(self) -> dict[str, Any]:
        """What was attached to the action."""
        return {k: v for k, v in self.__dict__.items() if k not in ("env_id", "action")}

    def __repr__(self) -> str:
        fields = ", ".join(f"{k}={v!r}" for k, v in self.__dict__.items())
        return f"PolicyResponse({fields})"


def default_env_preprocess_fn(policy_resp: PolicyResponse) -> Any:
    """The action as the policy gave it."""
    return policy_resp.action


class _Ret(BaseModel):
    """What single-agent and multi-agent results share."""

    model_config = ConfigDict(arbitrary_types_allowed=True, extra="forbid")

    env_id: str
    observation: Any
    info: dict[str, Any] = Field(default_factory=dict)
    ts_env_sent_ns: int = Field(default_factory=time.time_ns)
    _extra: dict[str, Any] = PrivateAttr(default_factory=dict)

    def __init__(self, *, _extra: dict[str, Any] | None = None, **data: Any) -> None:
        super().__init__(**data)
        if _extra is not None:
            self._extra = _extra


class EnvRet(_Ret):
    """One env's result of a reset or a step.

    Attributes:
        env_id: the env it came from.
        observation: fits the env's observation space (``[num_envs, *obs]`` if vectorised).
        last_reward: float, or ``[num_envs]`` if vectorised; 0.0 after a reset.
        last_terminated: bool, or ``[num_envs]`` bool.
        last_truncated: bool, or ``[num_envs]`` bool.
        info: what else the env reported.
        _extra: free for extensions.
        ts_env_sent_ns: when the env produced it, in ns since the epoch; for a client of an
            env_server, by the client's clock, which may differ from the trainer's.
    """

    last_reward: Any = 0.0
    last_terminated: Any = False
    last_truncated: Any = False

    # Said again, because type checkers make one up that knows no `_extra`.
    __init__ = _Ret.__init__


class MultiAgentEnvRet(_Ret):
    """One multi-agent env's result: every field but the info is a dict by agent."""

    observation: dict[str, Any]
    last_reward: dict[str, Any] = Field(default_factory=dict)
    last_terminated: dict[str, Any] = Field(default_factory=dict)
    last_truncated: dict[str, Any] = Field(default_factory=dict)

    __init__ = _Ret.__init__


class EnvMeta(BaseModel):
    """What `init` reports of each env.

    Attributes:
        env_id: unique in its group.
        observation_space: what `reset` and `step` return fits it; batched over the
            sub-environments when ``num_envs > 1``; by agent (a Dict) for multi-agent envs.
        action_space: what `step` accepts; batched and by agent likewise.
        num_envs: vectorised sub-environments.
        agents: agent names of a multi-agent env, in order; empty otherwise.
        max_episode_steps: the configured limit, or the simulator's own; None if none.
        autoreset: what a sub-environment does after the end of its episode, in Gymnasium's terms:
            wait for a reset (``disabled``); reset itself in the next step, whose action and
            reward count for nothing (``next_step``); or within the step that ends the
            episode, whose observation is then the first of the next (``same_step``).
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    env_id: str
    observation_space: gym.Space[Any] | None
    action_space: gym.Space[Any] | None
    num_envs: int = 1
    agents: tuple[str, ...] = ()
    max_episode_steps: int | None = None
    autoreset: Autoreset = "disabled"


class ClientTraits(NamedTuple):
    """What a client of an env_server makes of requests.

    Attributes:
        free_actions: its actions need not fit its action space.
        reads_extras: something there reads what the policy attaches beside the action.
    """

    free_actions: bool
    reads_extras: bool
