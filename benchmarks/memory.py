"""CartPole: how much memory does one env more take?

The proportional set size of all processes together, at 65 envs and at 1, divided by 64.
"""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from contenders import Stepped, Work, group_config
from harness import Question, Target, family, main

if TYPE_CHECKING:
    from collections.abc import Callable

FEW, MANY = 1, 65
WORK = Work("CartPole-v1", num_envs=MANY)

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


def kib_per_env(measure: Callable[[int], int]) -> float:
    """By how much `measure` grows with each env."""
    measure(FEW)  # Not measured: what is imported at first use.
    return (measure(MANY) - measure(FEW)) / (MANY - FEW)


@dataclass
class OursMemory(Stepped):
    package = "rlightning_aio"

    def _measure(self, num_envs: int) -> int:
        from rlightning_aio.sync import build_env_group

        config: dict[str, Any] = group_config(self.work, num_envs) | {"num_workers": num_envs}
        with build_env_group(config) as group:
            group.reset(seed=0)
            return resident_kib()

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        return kib_per_env(self._measure)


@dataclass
class GymnasiumMemory(Stepped):
    def _measure(self, num_envs: int) -> int:
        from gymnasium.vector import AsyncVectorEnv

        envs = AsyncVectorEnv(self.work.makers()[:num_envs], shared_memory=True)
        envs.reset(seed=0)
        held = resident_kib()
        envs.close()
        return held

    def round(self, seconds: float) -> float:
        del seconds  # The work gives the length.
        return kib_per_env(self._measure)


QUESTION = Question(
    name="memory",
    title="One CartPole env more",
    unit="KiB",
    contenders=[OursMemory(OURS, WORK), GymnasiumMemory(GYMNASIUM, WORK)],
    targets=[Target(OURS, GYMNASIUM, 0.1, at_most=True)],
    rounds=5,
    seconds=None,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
