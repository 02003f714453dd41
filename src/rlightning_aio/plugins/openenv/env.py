"""`openenv`: sessions of OpenEnv servers as awaitable envs.

Each env is one session. A reset begins an episode in it, over a new connection if the old one is
lost, and on another server if its own is gone. A step whose connection is lost has lost its env, as
a worker that dies has: its action may have taken effect, so no action is ever sent twice.
"""

from __future__ import annotations

import asyncio
import math
import time
import uuid
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
from gymnasium import spaces
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from rlightning_aio import Anything, BaseEnv, EnvAway, EnvRet
from rlightning_aio.envs.options import read_options
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.plugins.openenv.session import (
    OpenEnvSession,
    ServerGone,
    pauses,
)

if TYPE_CHECKING:
    import gymnasium as gym

    from rlightning_aio import EnvConfig, PolicyResponse


class OpenEnvOptions(BaseModel):
    """``env_kwargs`` of the backend."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    urls: tuple[str, ...] = ()
    """Further servers of the same environment; sessions are spread over all of them."""
    columns: dict[str, Any] = Field(default_factory=dict)
    """Fields of the observation that become columns: a Gymnasium space, a number n for
    ``Discrete(n)``, or ``{shape: […], dtype: …, low: …, high: …}`` for a ``Box``."""
    observation_field: str | None = None
    """The only field of the observation that counts: its value is the observation."""
    action_field: str | None = None
    """The only field of an action: an action is its value."""
    truncated_field: str | None = None
    """Field of the metadata or the observation that says that a done episode was only cut."""
    reset: dict[str, Any] = Field(default_factory=dict)
    """Arguments that are sent with each reset."""
    connect_timeout: float = Field(default=60.0, gt=0)
    """Seconds that a reset waits for a server that can be reached."""
    headers: dict[str, str] = Field(default_factory=dict, repr=False)
    """Sent with each connection, such as ``Authorization``; they are never logged."""

    @field_validator("headers")
    @classmethod
    def _check_headers(cls, headers: dict[str, str]) -> dict[str, str]:
        for name, value in headers.items():
            if not (name.isascii() and name.replace("-", "_").isidentifier()):
                raise ValueError(f"{name!r} is no name of a header")
            if not (value.isascii() and value.isprintable()):
                raise ValueError(f"the value of {name} has characters that are none of a header")
        return headers

    @model_validator(mode="after")
    def _check_fields(self) -> Self:
        if self.columns and self.observation_field is not None:
            raise ValueError("columns and observation_field exclude each other")
        return self


class OpenEnv(BaseEnv):
    """One session; see the module and docs/openenv.md.

    An observation is a dict of the fields that the server sends. With ``columns`` it is a dict of
    these, and of all other fields as ``rest``. An action is a dict of the action's fields. With
    ``observation_field`` or ``action_field`` it is the value of that field.
    """

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        options = read_options(OpenEnvOptions, self.env_id, config.env_kwargs)
        self._options = options
        self._columns = {
            name: _space_of(self.env_id, name, given) for name, given in options.columns.items()
        }
        self._urls = (config.task_name, *options.urls)
        self._url = self.worker_index % len(self._urls)
        self._session = self._new_session()
        self._has_reward = False  # In this episode.

    def _new_session(self) -> OpenEnvSession:
        return OpenEnvSession(self._urls[self._url], self._options.headers)

    def get_observation_space(self) -> gym.Space[Any]:
        """A value for each row, or columns with the ``rest``."""
        if not self._columns:
            return Anything()
        return spaces.Dict({**self._columns, "rest": Anything()})

    def get_action_space(self) -> gym.Space[Any]:
        """Dicts of an action's fields, or values of its only one."""
        return Anything()

    async def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        """Begin an episode.

        Args:
            seed: sent to the server.
            options: further arguments of the server's reset; they replace those of the config.

        Raises:
            ServerGone: no server could be reached within ``connect_timeout``.
            ServerRefused: the server's environment has raised.
        """
        arguments = {"episode_id": str(uuid.uuid4()), **self._options.reset, **(options or {})}
        if seed is not None:
            arguments["seed"] = seed
        data = await self._first_reply({"type": "reset", "data": arguments})
        self._has_reward = False
        observation, info = self._read(data)
        return EnvRet(env_id=self.env_id, observation=observation, info=info)

    async def _first_reply(self, message: dict[str, Any]) -> dict[str, Any]:
        """Ask this server, or else the first that can be reached again."""
        give_up_at = time.monotonic() + self._options.connect_timeout
        pause, failures = pauses(), 0
        while True:
            try:
                return await self._session.open(message)
            except ServerGone:
                failures += 1
                if failures > 1:  # At first only the socket may be lost.
                    self._url = (self._url + 1) % len(self._urls)
                    self._session = self._new_session()
                if time.monotonic() > give_up_at:
                    raise
            if failures > len(self._urls):
                await asyncio.sleep(next(pause))

    async def step(self, policy_resp: PolicyResponse) -> EnvRet:
        """Send an action, and wait for its observation.

        Raises:
            BadAction: the action is no dict, or has no form in JSON.
            EnvAway: the session is lost.
            ServerRefused: the server's environment has raised, or does not know the action.
        """
        action = self._preprocess_fn(policy_resp)
        if self._options.action_field is not None:
            action = {self._options.action_field: action}
        if not isinstance(action, Mapping):
            raise BadAction(
                f"an action of env {self.env_id!r} is a dict of its fields, not {action!r}"
            )
        try:
            data = await self._session.ask({"type": "step", "data": _plain(action)})
        except ServerGone as gone:
            raise EnvAway(f"lost its session: {gone}", env_id=self.env_id) from gone
        except (TypeError, ValueError) as error:
            raise BadAction(f"an action of env {self.env_id!r} is no JSON: {error}") from error
        observation, info = self._read(data)
        done = bool(data.get("done"))
        cut = done and self._is_cut(data, info)
        return EnvRet(
            env_id=self.env_id,
            observation=observation,
            last_reward=self._reward_of(data, done=done),
            last_terminated=done and not cut,
            last_truncated=cut,
            info=info,
        )

    def _reward_of(self, data: dict[str, Any], *, done: bool) -> float:
        """Read the reward: nothing yet counts as 0, but an episode without any has none (NaN)."""
        reward = data.get("reward")
        self._has_reward |= reward is not None
        if reward is None:
            return 0.0 if self._has_reward or not done else math.nan
        return float(reward)

    def _read(self, data: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return the observation and the info."""
        fields: dict[str, Any] = dict(data.get("observation") or {})
        inner = fields.pop("metadata", None)
        info: dict[str, Any] = dict(data.get("metadata") or inner or {})
        if self._columns:
            columns = {
                name: _value_in(space, _taken(fields, name, "columns"))
                for name, space in self._columns.items()
            }
            return {**columns, "rest": fields}, info
        field = self._options.observation_field
        return (fields if field is None else _taken(fields, field, "observation_field")), info

    def _is_cut(self, data: dict[str, Any], info: dict[str, Any]) -> bool:
        field = self._options.truncated_field
        observation: dict[str, Any] = data.get("observation") or {}
        return field is not None and bool(info.get(field, observation.get(field)))

    async def state(self) -> dict[str, Any]:
        """The server's state of the session, such as ``step_count``."""
        return await self._session.ask({"type": "state"})

    async def mcp(self, method: str, params: dict[str, Any] | None = None) -> Any:
        """Call a method of the environment's MCP server, such as ``tools/list``."""
        request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params or {}}
        return await self._session.ask({"type": "mcp", "data": request})

    def save_state(self) -> Any:
        """Refuse: a session is at its server, which can't copy it.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a session of an OpenEnv server can't be saved")

    async def close(self) -> None:
        """Close the session, and give its slot at the server back."""
        await self._session.close()


def _space_of(env_id: str, name: str, given: Any) -> gym.Space[Any]:
    if isinstance(given, spaces.Space):
        return cast("gym.Space[Any]", given)
    try:
        if isinstance(given, int):
            return spaces.Discrete(given)
        box: dict[str, Any] = {"low": -np.inf, "high": np.inf, "dtype": "float32", **given}
        dtype: Any = np.dtype(box.pop("dtype"))
        if dtype.kind in "iu":  # An integer has no infinity.
            limits = np.iinfo(dtype)
            box["low"] = max(box["low"], limits.min)
            box["high"] = min(box["high"], limits.max)
        return spaces.Box(dtype=dtype.type, **box)
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"{env_id}: env_kwargs: columns.{name}: {given!r} makes no space ({error}); give a "
            "number for Discrete, or shape, dtype, low and high for a Box"
        ) from None


def _taken(fields: dict[str, Any], name: str, option: str) -> Any:
    """Remove a field of an observation, and return its value."""
    if name not in fields:
        there = ", ".join(map(repr, fields)) or "none"
        raise ValueError(
            f"env_kwargs.{option} names {name!r}, and the observation's fields are {there}"
        )
    return fields.pop(name)


def _value_in(space: gym.Space[Any], value: Any) -> Any:
    """A field as an array of its column's shape and dtype; pixels may come flattened."""
    if space.shape is None or isinstance(space, Anything):
        return value
    return np.asarray(value, space.dtype).reshape(space.shape)


def _plain(value: Any) -> Any:
    """An action as JSON has it."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in cast("list[Any]", value)]
    return value.tolist() if hasattr(value, "tolist") else value
