"""Values of the public interface that concern one env.

Rule: the hot path uses columns (see `batch`), and makes these objects only on request.
Absent on purpose: anything that knows where an env runs.
"""

from __future__ import annotations

import time
from typing import Any, Literal, TypeAlias

import gymnasium as gym
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

Autoreset: TypeAlias = Literal["disabled", "next_step", "same_step"]
"""See `EnvMeta`."""


class PolicyResponse:
    """The policy's response to one env: an action and extra fields.

    Args:
        env_id: id of the env.
        action: an element of the action space, unless a preprocess function or the env transforms
            it.
        extras: further fields (``log_prob``, ``value``, …), which the preprocess function and the
            env's `step` can read as attributes.
    """

    def __init__(self, env_id: str, action: Any = None, **extras: Any) -> None:
        self.env_id = env_id
        self.action = action
        self.__dict__.update(extras)

    @property
    def extras(self) -> dict[str, Any]:
        """Fields other than `env_id` and `action`."""
        extras = self.__dict__.copy()
        del extras["env_id"], extras["action"]
        return extras

    def __repr__(self) -> str:
        fields = ", ".join(f"{k}={v!r}" for k, v in self.__dict__.items())
        return f"PolicyResponse({fields})"


def default_env_preprocess_fn(policy_resp: PolicyResponse) -> Any:
    """Return the action unchanged."""
    return policy_resp.action


class _Ret(BaseModel):
    """Fields of both single-agent and multi-agent results."""

    model_config = ConfigDict(arbitrary_types_allowed=True, extra="forbid", defer_build=True)

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
    """The result of a reset or a step of one env.

    Attributes:
        env_id: id of the env.
        observation: an element of the observation space (``[num_envs, *obs]`` if vectorised).
        last_reward: float, or ``[num_envs]`` if vectorised; 0.0 after a reset.
        last_terminated: bool, or ``[num_envs]`` bool.
        last_truncated: bool, or ``[num_envs]`` bool.
        info: further values that the env reported.
        _extra: free for extensions.
        ts_env_sent_ns: when the env produced it, in ns since the epoch; of a client of an
            env_server by the clock of the client.
    """

    last_reward: Any = 0.0
    last_terminated: Any = False
    last_truncated: Any = False

    # Repeated, because type checkers generate one without `_extra`.
    __init__ = _Ret.__init__


class MultiAgentEnvRet(_Ret):
    """The result of a multi-agent env: observation, reward and flags are dicts by agent."""

    observation: dict[str, Any]
    last_reward: dict[str, Any] = Field(default_factory=dict)
    last_terminated: dict[str, Any] = Field(default_factory=dict)
    last_truncated: dict[str, Any] = Field(default_factory=dict)

    __init__ = _Ret.__init__


def unchecked(
    kind: type[EnvRet | MultiAgentEnvRet],
    fields: dict[str, Any],
    extra: dict[str, Any] | None = None,
) -> EnvRet | MultiAgentEnvRet:
    """Make a result of all its fields, unchecked: in an eighth of the time.

    Args:
        kind: its class.
        fields: becomes a part of it.
        extra: its `_extra`.
    """
    made, give = kind.__new__(kind), object.__setattr__
    give(made, "__dict__", fields)
    give(made, "__pydantic_fields_set__", set(fields))
    give(made, "__pydantic_extra__", None)
    give(made, "__pydantic_private__", {"_extra": {} if extra is None else extra})
    return made


class EnvMeta(BaseModel):
    """Metadata of an env, as reported by `init`.

    Attributes:
        env_id: unique in its group.
        observation_space: of the observations of `reset` and `step`; batched over sub-environments
            if ``num_envs > 1``; a Dict by agent for multi-agent envs.
        action_space: of the actions of `step`; batched and by agent likewise.
        num_envs: number of vectorised sub-environments.
        agents: agent names of a multi-agent env, in order; empty otherwise.
        max_episode_steps: the configured limit, or that of the simulator; None without any.
        autoreset: when a sub-environment is reset after the end of its episode, in Gymnasium's
            terms: only on request (``disabled``); in the next step, whose action and reward are
            ignored (``next_step``); or in the step that ends the episode, whose observation is
            then the first of the next episode (``same_step``).
        task: the task of the config entry.
        switches_task: a reset with ``options={"task": name}`` switches the env to another task.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True, defer_build=True)

    env_id: str
    observation_space: gym.Space[Any] | None
    action_space: gym.Space[Any] | None
    num_envs: int = 1
    agents: tuple[str, ...] = ()
    max_episode_steps: int | None = None
    autoreset: Autoreset = "disabled"
    task: str = ""
    switches_task: bool = False
