"""A client whose images are compressed, beside one whose images are not."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from kit.counting import ClientThread, CountingEnv

import rlightning_aio as rl
from rlightning_aio import sync


class Camera(CountingEnv):
    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(0, 255, (64, 96, 3), np.uint8)

    def ret(self) -> rl.EnvRet:
        image = np.full((64, 96, 3), 40 * self.steps, np.uint8)
        return rl.EnvRet(env_id=self.env_id, observation=image)


def test_a_trainer_sees_the_same_images() -> None:
    pytest.importorskip("zstandard")
    server = {"name": "robots", "backend": "env_server", "step_timeout": 60}
    with sync.build_env_group(**server, env_kwargs={"clients": ["zstd", "None"]}) as group:
        address = group["robots-0"].address
        clients = [
            ClientThread(address, str(kind), Camera(), compression=kind) for kind in ("zstd", None)
        ]
        batch, _ = group.reset()
        for step in range(3):
            assert (batch.observation == 40 * step).all()
            batch, _ = group.step(batch.respond(action=np.zeros((2, 2), np.float32)))
    for client in clients:
        client.join()
