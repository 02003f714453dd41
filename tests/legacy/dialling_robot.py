"""``dialling_robot.py HOST PORT FOLDER``: RLightning's client, which serves twice, ten steps each.

Its first reset ends when four such clients are in theirs: each leaves a file in the folder.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from rlightning_aio.plugins.legacy.names import make_importable

make_importable()

from rlightning.env import BaseEnv  # noqa: E402
from rlightning.env.remote_env import RemoteEnvClient  # noqa: E402
from rlightning.types import EnvRet  # noqa: E402
from rlightning.utils.config import EnvConfig  # noqa: E402


class Robot(BaseEnv):
    steps = 0

    def reset(self) -> EnvRet:
        folder = Path(sys.argv[3])
        (folder / str(os.getpid())).touch()
        while len(list(folder.iterdir())) < 4:
            time.sleep(0.01)
        self.steps = 0
        return EnvRet(self.env_id, np.zeros(7, np.float32))

    def step(self, policy_resp: Any) -> EnvRet:
        self.steps += 1
        return EnvRet(policy_resp.env_id, np.full(7, self.steps, np.float32), 1.0)

    def get_observation_space(self) -> Any:
        return spaces.Box(-np.inf, np.inf, (7,), np.float32)

    def get_action_space(self) -> Any:
        return spaces.Box(-1, 1, (7,), np.float32)

    def is_finish(self) -> bool:
        return self.steps >= 10


client = RemoteEnvClient(
    Robot(EnvConfig(name="arm", backend="piper", task="any")), sys.argv[1], int(sys.argv[2])
)
for _ in range(2):
    client.connect()
    client.run()
