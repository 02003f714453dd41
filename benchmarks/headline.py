"""32 HalfCheetahs, made by `make_vec` and by Gymnasium's `AsyncVectorEnv`.

`make run` shows the same live (demo.py). The ratio depends on the time that the machine takes to
switch between processes.
"""

from __future__ import annotations

from contenders import GymnasiumAsync, MakeVec, Work
from harness import Question, Target, main

CHEETAHS = Work("HalfCheetah-v5", 32)
OURS = MakeVec("rlightning_aio make_vec", CHEETAHS)
GYMNASIUM = GymnasiumAsync("Gymnasium AsyncVectorEnv", CHEETAHS)

QUESTION = Question(
    name="headline",
    title="HalfCheetah-v5, 32 envs",
    unit="env steps/s",
    contenders=[OURS, GYMNASIUM],
    targets=[Target(OURS.name, GYMNASIUM.name, 4.0)],
    rounds=5,
    seconds=1.0,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
