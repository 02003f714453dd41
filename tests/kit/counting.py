"""An env that counts its steps, and clients that serve it."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from patience import HANG

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable


class CountingEnv(BaseEnv):
    """Its observation is (identity, seed of the reset, steps since the reset).

    It is finished once the server is gone, so that its client ends with the server.
    """

    def __init__(self, identity: int = 0, on_step: Callable[[], None] = lambda: None) -> None:
        super().__init__(EnvConfig(name="counting", backend="counting", task="none"))
        self.identity = identity
        self.on_step = on_step
        self.seed = -1
        self.steps = 0
        self.resets = 0
        self.disconnects = 0
        self.finished = False
        self.stays = False
        self.closed = False

    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1.0, np.inf, (3,), np.float64)

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def ret(self) -> EnvRet:
        observation = np.array([self.identity, self.seed, self.steps], float)
        return EnvRet(env_id=self.env_id, observation=observation, last_reward=float(self.steps))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> EnvRet:
        self.seed = -1 if seed is None else seed
        self.steps = 0
        self.resets += 1
        return self.ret()

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        self.on_step()
        self.steps += 1
        return self.ret()

    def is_finish(self) -> bool:
        return self.finished

    def on_disconnect(self) -> None:
        self.disconnects += 1
        self.finished = not self.stays

    def close(self) -> None:
        self.closed = True


def look(group: Any, seconds: float = 0.02, server: str = "robots-0") -> None:
    """Let the sockets of an env_server work, while nothing is asked of anybody."""
    time.sleep(seconds)
    group[server]._server.listener.on_readable()  # noqa: SLF001
    group._core.intake.apply_completions()  # noqa: SLF001


def served(**env_kwargs: Any) -> dict[str, Any]:
    """Fields of an env_server whose first env is robots-0; its calls wait long for clients."""
    kwargs = {"connect_timeout": HANG, **env_kwargs}
    return {"name": "robots", "backend": "env_server", "env_kwargs": kwargs}


class ClientThread:
    """A client in a thread of the test's process; it ends with its server."""

    def __init__(
        self, address: str, name: str, env: CountingEnv | None = None, **options: Any
    ) -> None:
        self.env = env or CountingEnv()
        self.error: BaseException | None = None
        self.client = RemoteEnvClient(self.env, address, name=name, **options)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            with self.client:
                self.client.run()
        except BaseException as error:  # noqa: BLE001  # `join` raises it again.
            self.error = error

    def join(self) -> None:
        self._thread.join(HANG)
        assert not self._thread.is_alive(), f"the client did not end: {self.client.state}"
        if self.error is not None:
            raise self.error
