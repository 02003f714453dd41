"""HalfCheetah-v5, 32 envs, through the interfaces of Gymnasium and Stable-Baselines3.

How far ahead is each of ours of the class whose place it takes, and what does it cost beside the
bare group? Infos are part of both interfaces, so they are made in every step; the bare group
makes them when somebody reads them, and nobody does.
"""

from __future__ import annotations

from dataclasses import dataclass

from contenders import GymnasiumAsync, OursSync, StableBaselines3, Stepped, Work, sampled
from harness import Question, Target, main

WORK = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")


@dataclass
class OursVector(Stepped):
    """`rlightning_aio.vector.VectorEnv`, its workers kept on their cores as the bare group's."""

    package = "rlightning_aio"

    def setup(self) -> None:
        from rlightning_aio.vector import VectorEnv

        self._envs = VectorEnv(self.work.makers(), cpu_affinity=True)
        self._actions = sampled(self._envs.single_action_space, self.work.num_envs)
        self._envs.reset(seed=0)

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs


@dataclass
class OursSb3(Stepped):
    """`rlightning_aio.sb3.VecEnv`, likewise."""

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "stable_baselines3")

    def setup(self) -> None:
        from rlightning_aio.sb3 import VecEnv

        self._envs = VecEnv(self.work.makers(), cpu_affinity=True)
        self._actions = sampled(self._envs.action_space, self.work.num_envs)
        self._envs.seed(0)
        self._envs.reset()

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs


VECTOR = "rlightning_aio VectorEnv"
SB3 = "rlightning_aio sb3.VecEnv"
BARE = "rlightning_aio sync"
GYMNASIUM = "Gymnasium AsyncVectorEnv"
SUBPROC = "SB3 SubprocVecEnv"

QUESTION = Question(
    name="adapters",
    title="HalfCheetah-v5, 32 envs, through others' interfaces",
    unit="env steps/s",
    contenders=[
        OursVector(VECTOR, WORK),
        OursSb3(SB3, WORK),
        OursSync(BARE, WORK),
        GymnasiumAsync(GYMNASIUM, WORK),
        StableBaselines3(SUBPROC, WORK),
    ],
    targets=[
        Target(VECTOR, GYMNASIUM, 3.5),
        Target(SB3, SUBPROC, 3.5),
        Target(VECTOR, BARE, 0.85),
        Target(SB3, BARE, 0.85),
    ],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
