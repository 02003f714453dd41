"""HalfCheetah-v5, 32 envs: all contenders in turn within one run.

Gymnasium's AsyncVectorEnv with shared memory and its SyncVectorEnv, Stable-Baselines3's
SubprocVecEnv, Tianshou's ShmemVectorEnv, TorchRL's ParallelEnv and AsyncEnvPool, PufferLib's
multiprocessing backend, EnvPool, a plain loop in one process, and this library. Peers that aren't
installed are left out: pip install -r requirements/bench.txt brings all but PufferLib, which `make
bench` adds. Gymnasium is always there. `stragglers.py` compares them with uneven step times.
"""

from __future__ import annotations

import os

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
from pufferlib_contender import PufferLib
from torchrl_contenders import TorchRLAsync, TorchRLParallel

WORK = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")

SYNC = "rlightning_aio sync"
HALF = "rlightning_aio async, 16 of 32"
GYMNASIUM = "Gymnasium AsyncVectorEnv"
PARALLEL = "TorchRL ParallelEnv"
POOL = "TorchRL AsyncEnvPool, 16 of 32"
PUFFER, HALF_PUFFER = "PufferLib, synchronous", "PufferLib, 16 of 32"
CORES = len(os.sched_getaffinity(0))

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
        TorchRLParallel(PARALLEL, WORK),
        TorchRLAsync("TorchRL AsyncEnvPool, all", WORK, envs_per_worker=WORK.num_envs // CORES),
        TorchRLAsync(POOL, WORK, min_results=16, envs_per_worker=WORK.num_envs // CORES),
        PufferLib(PUFFER, WORK),
        PufferLib(HALF_PUFFER, WORK, batch_size=16),
        EnvPool("EnvPool, synchronous", WORK),
        EnvPool("EnvPool, 16 of 32", WORK, batch_size=16),
        InProcess("in-process loop", WORK),
    ],
    targets=[
        Target(SYNC, GYMNASIUM, 3.5),
        Target(HALF, GYMNASIUM, 4.0),
        Target(SYNC, PARALLEL, 1.0),
        Target(HALF, POOL, 1.0),
        Target(SYNC, PUFFER, 1.0),
        Target(HALF, HALF_PUFFER, 1.0),
    ],
    rounds=5,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
