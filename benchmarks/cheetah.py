"""HalfCheetah-v5, 32 envs: compared with the machine's limit, and with Gymnasium.

The limit is one bare loop on each core. EnvPool steps the same task written in C++.
"""

from __future__ import annotations

from contenders import EnvPool, GymnasiumAsync, Limit, OursAsync, OursSync, Work
from harness import Question, Target, main

WORK = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")

SYNC = "rlightning_aio sync"
HALF = "rlightning_aio async, 16 of 32"
GYMNASIUM = "Gymnasium AsyncVectorEnv"
ENVPOOL_HALF = "EnvPool, 16 of 32"
LIMIT = "the limit"

QUESTION = Question(
    name="cheetah",
    title="HalfCheetah-v5, 32 envs",
    unit="env steps/s",
    contenders=[
        OursSync(SYNC, WORK),
        OursAsync(HALF, WORK, min_results=16),
        Limit(LIMIT, WORK),
        EnvPool(ENVPOOL_HALF, WORK, batch_size=16),
        GymnasiumAsync(GYMNASIUM, WORK),
    ],
    targets=[
        Target(SYNC, GYMNASIUM, 4.0),
        Target(SYNC, LIMIT, 0.85),
        Target(HALF, ENVPOOL_HALF, 0.95),
        Target(HALF, LIMIT, 0.90),
    ],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
