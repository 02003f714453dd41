"""CartPole: how much memory does one env more take?

The proportional set size of all processes together, with many envs and with one, by env.
"""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from contenders import Stepped, Work, group_config
from harness import Question, Target, family, main

if TYPE_CHECKING:
    from collections.abc import Callable

# Ours take so little that it needs many to be seen beside what else moves.
OURS_MANY, GYMNASIUM_MANY = 1025, 65
TASK = "CartPole-v1"

OURS = "rlightning_aio, all in one worker"
GYMNASIUM = "Gymnasium AsyncVectorEnv"


def resident_kib() -> int:
    """What this process and all that come from it hold, shared pages shared out."""
    gc.collect()
    total = 0
    for threads in family(os.getpid()):
        for line in (threads[0].parent.parent / "smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += int(line.split()[1])
    return total


def kib_per_env(measure: Callable[[int], int], many: int) -> float:
    """By how much `measure` grows with each env."""
    measure(many)  # Not counted: what is imported and allocated at first use.
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
