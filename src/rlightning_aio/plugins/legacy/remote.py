"""RLightning's client and server of remote envs, over our own wire format, without pickle.

Both ends must run this code: RLightning's own client uses another format.
"""

from __future__ import annotations

import os
import socket
import uuid
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np

from rlightning_aio import BaseEnv as OurEnv
from rlightning_aio import EnvConfig, EnvRet, PolicyResponse
from rlightning_aio.plugins.legacy.env import BaseEnv
from rlightning_aio.plugins.legacy.group import EnvGroup
from rlightning_aio.plugins.legacy.names import names_in_use
from rlightning_aio.plugins.legacy.registry import ENVS
from rlightning_aio.remote import RemoteEnvClient as OurClient
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["RemoteEnvClient", "RemoteEnvServer"]

_ANY_ACTION: Final = gym.spaces.Box(-np.inf, np.inf, (), np.float32)
"""Announced by an env without an action space."""


class _DialledEnv(OurEnv):
    """A client's env, with results in our own form."""

    transforms_actions = True

    def __init__(self, env: Any) -> None:
        super().__init__(EnvConfig(name="rlightning", backend="callable"))
        self.env = env
        self.num_envs = env.num_envs
        self._first: EnvRet | None = None
        self._observation_space = env.get_observation_space()
        if self._observation_space is None:
            # A robot's env may know its space only after its cameras have sent something.
            self._first = self.reset()
            self._observation_space = _space_around(self._first.observation)
        self._action_space = env.get_action_space() or _ANY_ACTION

    def get_observation_space(self) -> gym.Space[Any]:
        return self._observation_space

    def get_action_space(self) -> gym.Space[Any]:
        return self._action_space

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        given = {"seed": seed, "options": options}
        given = {name: value for name, value in given.items() if value is not None}
        first, self._first = self._first, None
        if first is not None and not given:
            return first
        return self._as_ours(self.env._reset(**given))  # noqa: SLF001

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        data = {"action": policy_resp.action, **policy_resp.extras}
        return self._as_ours(self.env._step(_response(self.env.env_id, **data)))  # noqa: SLF001

    def _as_ours(self, ret: Any) -> EnvRet:
        return EnvRet(
            env_id=self.env_id,
            observation=as_numpy(ret.observation),
            last_reward=as_numpy(ret.last_reward),
            last_terminated=as_numpy(ret.last_terminated),
            last_truncated=as_numpy(ret.last_truncated),
            info=as_numpy(ret.info),
            _extra=as_numpy(ret._extra),
        )

    def is_finish(self) -> bool:
        return self.env.is_finish()

    def on_disconnect(self) -> None:
        stop = getattr(self.env, "on_disconnect", None)
        if stop is not None:
            stop()

    def close(self) -> None:
        """Do nothing: RLightning's client leaves its env open, to serve again."""


def _response(env_id: str, **data: Any) -> Any:
    return names_in_use().PolicyResponse(env_id, **data)


def _space_around(observation: Any) -> gym.Space[Any]:
    """Return an unbounded space for observations like this one."""
    if isinstance(observation, dict):
        parts = cast("Mapping[str, Any]", observation).items()
        return gym.spaces.Dict({key: _space_around(part) for key, part in parts})
    if isinstance(observation, tuple):
        return gym.spaces.Tuple([_space_around(part) for part in cast("Any", observation)])
    array: NDArray[Any] = np.asarray(observation)
    low, high = -np.inf, np.inf
    if array.dtype.kind in "iu":
        low, high = np.iinfo(array.dtype).min, np.iinfo(array.dtype).max
    if array.dtype.kind == "b":
        low, high = 0, 1
    return gym.spaces.Box(low, high, array.shape, cast("Any", array.dtype.type))


class RemoteEnvClient:
    """Serves an env of RLightning's kind to an env_server, once or more often.

    Args:
        env: stepped on the caller's thread.
        hostname, port: of the env_server.

    Attributes:
        zmq_identity: its name on the server; None before `connect`.
    """

    def __init__(self, env: Any, hostname: str, port: int) -> None:
        self.env = env
        self.hostname = hostname
        self.port = int(port)
        self.zmq_identity: str | None = None
        self._name = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        self._client: OurClient | None = None

    def connect(self) -> None:
        """Connect, and wait until the server has accepted the client.

        An env without an observation space is reset before, to find one. The server gets the first
        result in `run`, and its `reset` waits for that.
        """
        if self._client is None:
            self._client = OurClient(
                _DialledEnv(self.env), self.hostname, self.port, name=self._name
            )
        self.zmq_identity = self._client.name
        self._client.connect()

    def run(self) -> None:
        """Serve until ``env.is_finish()`` is true after a reply; then close the connection."""
        self.connect()
        client = self._client
        assert client is not None
        try:
            client.run()
        finally:
            self.close()

    def close(self) -> None:
        """Close the connection; the env stays open."""
        client, self._client = self._client, None
        if client is not None:
            client.close()


class RemoteEnvServer(BaseEnv):
    """An env_server on its own, without a group."""

    max_envs = 32

    def __init__(
        self,
        config: Any,
        worker_index: int | None = 0,
        preprocess_fn: Any = None,
        **kwargs: Any,
    ) -> None:
        del kwargs  # Accepted so that subclasses can pass on all their arguments.
        super().__init__(config, worker_index, preprocess_fn)
        self._group: EnvGroup | None = None

    @property
    def _listening(self) -> EnvGroup:
        if self._group is None:
            raise RuntimeError("this env_server is not listening yet; call init() first")
        return self._group

    def init(self) -> None:
        """Start listening."""
        self._group = EnvGroup([self.config])
        self.env_id = self._group.env_ids[0]

    def get_address_port(self) -> tuple[str, int]:
        """Return the host and port for clients."""
        return self._listening.env_servers[0].get_address_port()

    def reset(self, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Wait for clients, and return the first result of each."""
        batch, _ = self._listening.reset(*args, **kwargs)
        return batch.values()

    def step(self, policy_resp: Any) -> Any:
        raise NotImplementedError("an env_server has no synchronous step; use step_async")

    def step_async(self, policy_resp_list: Sequence[Any]) -> None:
        """Send each response to its client."""
        responses = list(policy_resp_list)
        batch = names_in_use().BatchedData([self.env_id] * len(responses), responses)
        self._listening.step_async(batch)

    def collect_async(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Return results; wait for the first, at most `timeout` seconds."""
        return self._listening.results_within(timeout)

    def get_observation_space(self) -> Any:
        """Return None: only its clients' envs have spaces."""

    def get_action_space(self) -> Any:
        """Return None: only its clients' envs have spaces."""

    def close(self) -> None:
        group, self._group = self._group, None
        if group is not None:
            group.close()


ENVS.provide("env_server", RemoteEnvServer)
