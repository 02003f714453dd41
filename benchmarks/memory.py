"""CartPole: how much memory does an additional env need?

The difference in proportional set size of all processes together, between many envs and one,
divided by the number of envs.
"""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from contenders import Stepped, Work, group_config
from harness import Question, Target, main

from rlightning_aio.cli.measurement import family, memory_bytes

if TYPE_CHECKING:
    from collections.abc import Callable

# Our envs need so little memory that only many of them show against the noise.
OURS_MANY, GYMNASIUM_MANY = 1025, 65
TASK = "CartPole-v1"

OURS = "rlightning_aio, all in one worker"
GYMNASIUM = "Gymnasium AsyncVectorEnv"


def resident_kib() -> int:
    """Return the memory of this process and its descendants; shared pages count in part."""
    gc.collect()
    return memory_bytes(list(family(os.getpid()))) // 1024


def kib_per_env(measure: Callable[[int], int], many: int) -> float:
    """Return the growth of `measure` with each env."""
    measure(many)  # Imports and allocations at first use are not counted.
    return (measure(many) - measure(1)) / (many - 1)


@dataclass
class OursMemory(Stepped):
    package = "rlightning_aio"

    def _measure(self, num_envs: int) -> int:
        from rlightning_aio.sync import build_env_group

        with build_env_group(group_config(Work(TASK, num_envs), num_envs)) as group:
            group.reset(seed=0)
            return resident_kib()

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        return kib_per_env(self._measure, self.work.num_envs)


@dataclass
class GymnasiumMemory(Stepped):
    def _measure(self, num_envs: int) -> int:
        from gymnasium.vector import AsyncVectorEnv

        envs = AsyncVectorEnv(Work(TASK, num_envs).makers(), shared_memory=True)
        envs.reset(seed=0)
        held = resident_kib()
        envs.close()
        return held

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        return kib_per_env(self._measure, self.work.num_envs)


QUESTION = Question(
    name="memory",
    title="One CartPole env more",
    unit="KiB",
    contenders=[
        OursMemory(OURS, Work(TASK, OURS_MANY)),
        GymnasiumMemory(GYMNASIUM, Work(TASK, GYMNASIUM_MANY)),
    ],
    targets=[Target(OURS, GYMNASIUM, 0.1, at_most=True)],
    rounds=5,
    seconds=None,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
