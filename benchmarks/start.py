"""The time from building the group to the first observations of 64 CartPoles, and from `make_vec`
to the first step of 32 HalfCheetahs.

The libraries are imported already; closing is not measured.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib import import_module

from contenders import GymnasiumAsync, GymnasiumVector, MakeVec, Stepped, Work, group_config
from harness import Question, Target, main

WORK = Work("CartPole-v1", num_envs=64)

CHEETAHS = Work("HalfCheetah-v5", num_envs=32)

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


@dataclass
class FirstStep(GymnasiumVector):
    """The time from making a vector environment to the results of its first step.

    Attributes:
        vector: makes it.
    """

    vector: type[GymnasiumVector] = GymnasiumAsync

    def setup(self) -> None:
        import_module("rlightning_aio.vector")
        import_module("gymnasium.envs.mujoco")

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        began = time.perf_counter()
        envs = self.vector(self.name, self.work).make()
        envs.reset(seed=0)
        envs.step(envs.action_space.sample())
        taken = time.perf_counter() - began
        envs.close()
        return taken


MADE = FirstStep("make_vec, 32 HalfCheetahs, first step", CHEETAHS, MakeVec)
ASYNC_MADE = FirstStep("AsyncVectorEnv, 32 HalfCheetahs, first step", CHEETAHS)
QUESTION = Question(
    name="start",
    title="64 CartPoles to their first observations, 32 HalfCheetahs to their first step",
    unit="s",
    contenders=[OursStart(OURS, WORK), GymnasiumStart(GYMNASIUM, WORK), MADE, ASYNC_MADE],
    targets=[
        Target(GYMNASIUM, OURS, 3.0),
        Target(MADE.name, ASYNC_MADE.name, 0.5, at_most=True),
    ],
    seconds=None,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
