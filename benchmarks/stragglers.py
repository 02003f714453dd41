"""64 envs that sleep for log-normal times, one in each worker: does anybody wait for the slow?

The ideal is as many processes that do nothing but sleep in turn, with no runtime around.
"""

from __future__ import annotations

import no_work
from contenders import GymnasiumAsync, Limit, OursAsync, Work
from harness import Question, Target, main

NUM_ENVS = 64
WORK = Work(no_work.SLEEPS, NUM_ENVS, modules=("no_work",))

ASYNC = "rlightning_aio async, first ready"
IDEAL = "64 processes without a runtime"

QUESTION = Question(
    name="stragglers",
    title="64 envs that sleep (log-normal, median 2 ms, sigma 1.5)",
    unit="env steps/s",
    contenders=[
        OursAsync(ASYNC, WORK, envs_per_process=1, auto_reset=False),
        Limit(IDEAL, WORK, processes=NUM_ENVS, steps_per_look=1),
        GymnasiumAsync("Gymnasium AsyncVectorEnv", WORK),
    ],
    targets=[Target(ASYNC, IDEAL, 0.9)],
    rounds=5,
    # Several times the 1.6 seconds in which an env has slept every one of its times.
    seconds=5.0,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
