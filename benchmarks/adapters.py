"""HalfCheetah-v5, 32 envs, through the interfaces of Gymnasium and Stable-Baselines3.

How far ahead is each of ours of the class whose place it takes, and what does it cost beside the
bare group? Over callables, which make separate envs, and by the task's name, which has each worker,
and the trainer's process, step its share together. `VectorEnv` makes
infos in every step; `sb3.VecEnv` and the bare group when somebody reads them, and nobody does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from contenders import (
    GymnasiumAsync,
    GymnasiumVector,
    OursSync,
    Sb3Vector,
    StableBaselines3,
    Work,
)
from harness import Question, Target, main

WORK = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")


@dataclass
class OursVector(GymnasiumVector):
    """`rlightning_aio.vector.VectorEnv`, with its workers pinned to cores like the bare group's."""

    package = "rlightning_aio"

    def make(self) -> Any:
        from rlightning_aio.vector import VectorEnv

        return VectorEnv(self.work.makers(), cpu_affinity=True)


@dataclass
class OursSb3(Sb3Vector):
    """`rlightning_aio.sb3.VecEnv`, likewise."""

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "stable_baselines3")

    def make(self) -> Any:
        from rlightning_aio.sb3 import VecEnv

        return VecEnv(self.work.makers(), cpu_affinity=True)


@dataclass
class OursMadeVector(GymnasiumVector):
    """`rlightning_aio.vector.make_vec`, where each worker steps its envs together."""

    package = "rlightning_aio"

    def make(self) -> Any:
        from rlightning_aio.vector import make_vec

        return make_vec(self.work.task, self.work.num_envs, vector_kwargs={"cpu_affinity": True})


@dataclass
class OursMadeSb3(Sb3Vector):
    """`rlightning_aio.sb3.make_vec_env`, likewise, without its monitor, which no peer has."""

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "stable_baselines3")

    def make(self) -> Any:
        from rlightning_aio.sb3 import make_vec_env

        arguments = {"env_kwargs": {"render_mode": None}, "vec_env_kwargs": {"cpu_affinity": True}}
        return make_vec_env(self.work.task, self.work.num_envs, **arguments).venv


VECTOR = "rlightning_aio VectorEnv"
MADE_VECTOR = "rlightning_aio make_vec, together"
MADE_SB3 = "rlightning_aio sb3.make_vec_env, together"
BARE_TOGETHER = "rlightning_aio sync, together"
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
        OursMadeVector(MADE_VECTOR, WORK),
        OursMadeSb3(MADE_SB3, WORK),
        OursSync(BARE_TOGETHER, replace(WORK, together=WORK.num_envs, placement="inline")),
        GymnasiumAsync(GYMNASIUM, WORK),
        StableBaselines3(SUBPROC, WORK),
    ],
    targets=[
        Target(VECTOR, GYMNASIUM, 3.5),
        Target(SB3, SUBPROC, 3.5),
        Target(VECTOR, BARE, 0.85),
        Target(SB3, BARE, 0.85),
        Target(MADE_VECTOR, GYMNASIUM, 3.5),
        Target(MADE_SB3, SUBPROC, 3.5),
        Target(MADE_VECTOR, BARE_TOGETHER, 0.85),
        Target(MADE_SB3, BARE_TOGETHER, 0.85),
    ],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
