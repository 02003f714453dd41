"""Humanoid-v5, 16 envs: the overhead for a heavier simulator.

Its step takes about ten times as long as HalfCheetah's, and its observations are twenty times as
large.
"""

from __future__ import annotations

from contenders import GymnasiumAsync, Limit, OursAsync, OursSync, Work
from harness import Question, Target, main

WORK = Work("Humanoid-v5", num_envs=16, backend="mujoco")

SYNC = "rlightning_aio sync"
LIMIT = "the limit"

QUESTION = Question(
    name="humanoid",
    title="Humanoid-v5, 16 envs",
    unit="env steps/s",
    contenders=[
        OursSync(SYNC, WORK),
        OursAsync("rlightning_aio async, 8 of 16", WORK, min_results=8),
        Limit(LIMIT, WORK),
        GymnasiumAsync("Gymnasium AsyncVectorEnv", WORK),
    ],
    targets=[Target(SYNC, LIMIT, 0.92)],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
