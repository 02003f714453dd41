"""64 envs that sleep for log-normal times, one in each worker: who waits for slow envs?

The ideal is as many processes that only sleep, without a runtime. The pool of TorchRL and PufferLib
also hand out the first ready results; Gymnasium and ParallelEnv wait for all.
"""

from __future__ import annotations

import no_work
from contenders import GymnasiumAsync, Limit, OursAsync, Work
from harness import Question, Target, main
from pufferlib_contender import PufferLib
from torchrl_contenders import TorchRLAsync, TorchRLParallel

NUM_ENVS = 64
WORK = Work(no_work.SLEEPS, NUM_ENVS, modules=("no_work",))

ASYNC = "rlightning_aio async, first ready"
IDEAL = "64 processes without a runtime"
POOL = "TorchRL AsyncEnvPool, first ready"
PUFFER = "PufferLib, first ready"

QUESTION = Question(
    name="stragglers",
    title="64 envs that sleep (log-normal, median 2 ms, sigma 1.5)",
    unit="env steps/s",
    contenders=[
        OursAsync(ASYNC, WORK, envs_per_process=1, auto_reset=False),
        Limit(IDEAL, WORK, processes=NUM_ENVS, steps_per_look=1),
        GymnasiumAsync("Gymnasium AsyncVectorEnv", WORK),
        TorchRLParallel("TorchRL ParallelEnv", WORK),
        TorchRLAsync(POOL, WORK, min_results=1),
        PufferLib(PUFFER, WORK, batch_size=1, num_workers=NUM_ENVS),
    ],
    targets=[
        Target(ASYNC, IDEAL, 0.9),
        Target(ASYNC, POOL, 1.0),
        Target(ASYNC, PUFFER, 1.0),
    ],
    rounds=5,
    # Several times the 1.6 seconds of a full cycle of an env's times.
    seconds=5.0,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
