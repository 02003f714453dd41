"""CartPole-v1, 64 envs: is a runtime worth its cost for an env that steps in microseconds?

It is compared with Gymnasium's processes, and with the same 64 envs stepped in a plain loop.
"""

from __future__ import annotations

from contenders import GymnasiumAsync, InProcess, Limit, OursAsync, OursSync, Work
from harness import Question, Target, main

WORK = Work("CartPole-v1", num_envs=64)

SYNC = "rlightning_aio sync"
GYMNASIUM = "Gymnasium AsyncVectorEnv"
IN_PROCESS = "in-process loop"

QUESTION = Question(
    name="cartpole",
    title="CartPole-v1, 64 envs",
    unit="env steps/s",
    contenders=[
        OursSync(SYNC, WORK),
        OursAsync("rlightning_aio async, 32 of 64", WORK, min_results=32),
        InProcess(IN_PROCESS, WORK),
        Limit("the limit", WORK),
        GymnasiumAsync(GYMNASIUM, WORK),
    ],
    targets=[Target(SYNC, GYMNASIUM, 10.0), Target(SYNC, IN_PROCESS, 1.0)],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
