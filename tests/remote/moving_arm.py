"""``moving_arm.py ADDRESS LOG``: a client whose env moves something real.

It writes a line into the file LOG before each motion. While a file LOG.hold exists, a motion goes
on, until the arm is stopped, which makes the file LOG.stopped. It ends with the
program that started it, or when there is a file LOG.end, and doesn't close its client.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.types import EnvRet

if TYPE_CHECKING:
    from rlightning_aio.types import PolicyResponse


class Arm(BaseEnv):
    """Each reset and each step is a motion."""

    def __init__(self, log: Path) -> None:
        super().__init__(EnvConfig(name="arm", backend="arm", task="-"))
        self._log = log
        self._hold = log.with_suffix(".hold")
        self._stopped = log.with_suffix(".stopped")

    def stop(self) -> None:
        self._stopped.touch()

    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _move(self, what: str) -> EnvRet:
        with self._log.open("a") as file:
            file.write(f"{what}\n")
        self._stopped.unlink(missing_ok=True)
        while self._hold.exists():
            if self._stopped.exists():
                raise RuntimeError("the arm was stopped on its way")
            time.sleep(0.01)
        return EnvRet(env_id=self.env_id, observation=np.zeros(2, np.float32))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> EnvRet:
        del options
        return self._move(f"reset {seed}")

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        del policy_resp
        return self._move("step")


def end_with_parent() -> None:
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(0.1)
    os._exit(0)


if __name__ == "__main__":
    address, log = sys.argv[1:]
    threading.Thread(target=end_with_parent, daemon=True).start()
    client = RemoteEnvClient(Arm(Path(log)), address, name="arm", hardware=True)
    serving = threading.Thread(target=client.run, daemon=True)
    serving.start()
    while serving.is_alive() and not Path(log).with_suffix(".end").exists():
        time.sleep(0.01)
