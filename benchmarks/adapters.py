"""HalfCheetah-v5, 32 envs, through the interfaces of Gymnasium and Stable-Baselines3; own envs.

How far ahead is each of ours of the class whose place it takes, and what does it cost beside the
bare group? Over callables, which make separate envs, and by the task's name, which has each worker,
and the trainer's process, step its share together. `VectorEnv` makes
infos in every step; `sb3.VecEnv` and the bare group when somebody reads them, and nobody does.

Own envs may wait or compute, so `VectorEnv` gives each a worker. What does that gain eight that
sleep for 10 ms, beside `AsyncVectorEnv`, and cost 32 that compute for 1 ms, beside sharing workers
by core?
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import no_work
from contenders import (
    GymnasiumAsync,
    GymnasiumVector,
    OursSync,
    Sb3Vector,
    StableBaselines3,
    Work,
)
from harness import Question, Target, main

from rlightning_aio.sharing import num_cores

WORK = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")
NAPS = Work(no_work.NAPS_10_MS, num_envs=8, modules=("no_work",))
COMPUTES = Work(no_work.WORKS_1_MS, num_envs=32, modules=("no_work",))


@dataclass
class OursVector(GymnasiumVector):
    """`rlightning_aio.vector.VectorEnv`, with a worker for each core like the bare group."""

    package = "rlightning_aio"

    def make(self) -> Any:
        from rlightning_aio.vector import VectorEnv

        return VectorEnv(self.work.makers(), max_concurrency=num_cores())


@dataclass
class OwnEnvs(GymnasiumVector):
    """`rlightning_aio.vector.VectorEnv` of one's own envs; None: as it is by default."""

    max_concurrency: int | None = None

    package = "rlightning_aio"

    def make(self) -> Any:
        from rlightning_aio.vector import VectorEnv

        return VectorEnv(self.work.makers(), max_concurrency=self.max_concurrency)


@dataclass
class OursSb3(Sb3Vector):
    """`rlightning_aio.sb3.VecEnv`, likewise."""

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "stable_baselines3")

    def make(self) -> Any:
        from rlightning_aio.sb3 import VecEnv

        share = -(-self.work.num_envs // num_cores())
        return VecEnv(self.work.makers(), envs_per_process=share)


@dataclass
class OursMadeVector(GymnasiumVector):
    """`rlightning_aio.vector.make_vec`, where each worker steps its envs together."""

    package = "rlightning_aio"

    def make(self) -> Any:
        from rlightning_aio.vector import make_vec

        return make_vec(self.work.task, self.work.num_envs)


@dataclass
class OursMadeSb3(Sb3Vector):
    """`rlightning_aio.sb3.make_vec_env`, likewise, without its monitor, which no peer has."""

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "stable_baselines3")

    def make(self) -> Any:
        from rlightning_aio.sb3 import make_vec_env

        arguments = {"env_kwargs": {"render_mode": None}}
        return make_vec_env(self.work.task, self.work.num_envs, **arguments).venv


VECTOR = "rlightning_aio VectorEnv"
MADE_VECTOR = "rlightning_aio make_vec, together"
MADE_SB3 = "rlightning_aio sb3.make_vec_env, together"
BARE_TOGETHER = "rlightning_aio sync, together"
SB3 = "rlightning_aio sb3.VecEnv"
BARE = "rlightning_aio sync"
GYMNASIUM = "Gymnasium AsyncVectorEnv"
SUBPROC = "SB3 SubprocVecEnv"
NAPPING = "rlightning_aio VectorEnv, 8 that sleep 10 ms"
GYMNASIUM_NAPPING = "Gymnasium AsyncVectorEnv, 8 that sleep 10 ms"
COMPUTING = "rlightning_aio VectorEnv, 32 that compute 1 ms"
BY_CORE = "rlightning_aio VectorEnv, 32 that compute 1 ms, by core"

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
        OwnEnvs(NAPPING, NAPS),
        GymnasiumAsync(GYMNASIUM_NAPPING, NAPS),
        OwnEnvs(COMPUTING, COMPUTES),
        OwnEnvs(BY_CORE, COMPUTES, num_cores()),
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
        Target(NAPPING, GYMNASIUM_NAPPING, 0.95),
        Target(COMPUTING, BY_CORE, 0.85),
    ],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
