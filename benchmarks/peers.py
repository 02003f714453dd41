"""HalfCheetah-v5, 32 envs: everybody in turn within one run.

Gymnasium's AsyncVectorEnv with shared memory and its SyncVectorEnv, Stable-Baselines3's
SubprocVecEnv, Tianshou's ShmemVectorEnv, EnvPool, a plain loop in one process, and this
library. Peers that aren't installed are left out: pip install 'rlightning-aio[bench]' brings
them. Gymnasium is always there.
"""

from __future__ import annotations

from contenders import (
    EnvPool,
    GymnasiumAsync,
    GymnasiumSync,
    InProcess,
    OursAsync,
    OursSync,
    StableBaselines3,
    Tianshou,
    Work,
)
from harness import Question, Target, main

WORK = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")

SYNC = "rlightning_aio sync"
HALF = "rlightning_aio async, 16 of 32"
GYMNASIUM = "Gymnasium AsyncVectorEnv"

QUESTION = Question(
    name="peers",
    title="HalfCheetah-v5, 32 envs, everybody",
    unit="env steps/s",
    contenders=[
        OursSync(SYNC, WORK),
        OursAsync(HALF, WORK, min_results=16),
        GymnasiumAsync(GYMNASIUM, WORK),
        GymnasiumSync("Gymnasium SyncVectorEnv", WORK),
        StableBaselines3("SB3 SubprocVecEnv", WORK),
        Tianshou("Tianshou ShmemVectorEnv", WORK),
        EnvPool("EnvPool, synchronous", WORK),
        EnvPool("EnvPool, 16 of 32", WORK, batch_size=16),
        InProcess("in-process loop", WORK),
    ],
    targets=[Target(SYNC, GYMNASIUM, 3.5), Target(HALF, GYMNASIUM, 4.0)],
    rounds=5,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
