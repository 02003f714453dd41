"""ALE/Pong-v5, 8 envs, raw frames of 210x160x3 bytes: what do large observations cost?

Every contender hands out frames that are not overwritten later.
"""

from __future__ import annotations

from contenders import GymnasiumAsync, Limit, OursAsync, OursSync, Work
from harness import Question, Target, main

# The usual limit of 108,000 frames, four to a step.
WORK = Work("ALE/Pong-v5", 8, modules=("ale_py",), backend="ale", max_episode_steps=27_000)

SYNC = "rlightning_aio sync"
GYMNASIUM = "Gymnasium AsyncVectorEnv"
LIMIT = "the limit"

QUESTION = Question(
    name="pong",
    title="ALE/Pong-v5, raw frames, 8 envs",
    unit="env steps/s",
    contenders=[
        OursSync(SYNC, WORK),
        OursAsync("rlightning_aio async, 4 of 8", WORK, min_results=4),
        Limit(LIMIT, WORK),
        GymnasiumAsync(GYMNASIUM, WORK),
    ],
    targets=[Target(SYNC, GYMNASIUM, 1.5), Target(SYNC, LIMIT, 0.85)],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
