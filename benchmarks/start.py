"""64 CartPole envs: how long from building the group to the first observations?

The libraries are imported already; closing is not measured.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib import import_module

from contenders import Stepped, Work, group_config
from harness import Question, Target, main

WORK = Work("CartPole-v1", num_envs=64)

OURS = "rlightning_aio"
GYMNASIUM = "Gymnasium AsyncVectorEnv"


@dataclass
class OursStart(Stepped):
    package = "rlightning_aio"

    def setup(self) -> None:
        import_module("rlightning_aio.sync")
        self._config = group_config(self.work, "auto")

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        from rlightning_aio.sync import build_env_group

        began = time.perf_counter()
        with build_env_group(self._config) as group:
            batch, _ = group.reset(seed=0)
            _ = batch.observation
            return time.perf_counter() - began


@dataclass
class GymnasiumStart(Stepped):
    def setup(self) -> None:
        import_module("gymnasium.vector")

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        from gymnasium.vector import AsyncVectorEnv

        began = time.perf_counter()
        envs = AsyncVectorEnv(self.work.makers(), shared_memory=True)
        envs.reset(seed=0)
        taken = time.perf_counter() - began
        envs.close()
        return taken


QUESTION = Question(
    name="start",
    title="64 CartPole envs to their first observations",
    unit="s",
    contenders=[OursStart(OURS, WORK), GymnasiumStart(GYMNASIUM, WORK)],
    targets=[Target(GYMNASIUM, OURS, 3.0)],
    seconds=None,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
