"""RLightning's client of an env_server, over our own wire format, without pickle.

Both ends must run this code: RLightning's own client uses another format.
"""

from __future__ import annotations

import os
import socket
import uuid
from typing import TYPE_CHECKING, Any

from rlightning_aio import BaseEnv as OurEnv
from rlightning_aio import EnvConfig, EnvRet, PolicyResponse
from rlightning_aio.plugins.legacy.hosted import call_first
from rlightning_aio.plugins.legacy.names import named
from rlightning_aio.remote import RemoteEnvClient as OurClient
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    import gymnasium as gym


class _DialledEnv(OurEnv):
    """A client's env, with results in our own form."""

    transforms_actions = True

    def __init__(self, env: Any) -> None:
        super().__init__(EnvConfig(name="rlightning", backend="callable"))
        self.env = env
        self.num_envs = env.num_envs

    def get_observation_space(self) -> gym.Space[Any]:
        return self.env.get_observation_space()

    def get_action_space(self) -> gym.Space[Any]:
        return self.env.get_action_space()

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        given = {"seed": seed, "options": options}
        given = {name: value for name, value in given.items() if value is not None}
        return self._as_ours(self.env._reset(**given))  # noqa: SLF001

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        data = {"action": policy_resp.action, **policy_resp.extras}
        response = named("PolicyResponse")(self.env.env_id, **data)
        return self._as_ours(self.env._step(response))  # noqa: SLF001

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
        call_first(self.env, "on_disconnect", "stop")

    def close(self) -> None:
        """Do nothing: RLightning's client leaves its env open, to serve again."""


class RemoteEnvClient:
    """Serves an env of RLightning's kind to an env_server, once or more often.

    Args:
        env: stepped on the caller's thread.
        hostname, port: of the env_server.
    """

    def __init__(self, env: Any, hostname: str, port: int) -> None:
        self.env = env
        self._address = hostname, int(port)
        self._name = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        self._client: OurClient | None = None

    def connect(self) -> None:
        """Connect, and wait until the server has accepted the client.

        The env tells it its spaces, and moves nothing before the server asks for a reset.
        """
        if self._client is None:
            self._client = OurClient(
                _DialledEnv(self.env), *self._address, name=self._name, hardware=False
            )
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
