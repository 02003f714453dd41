"""Many simulations to a worker, stepped with one call: ahead of EnvPool, near the ceiling?

The ceiling is one such loop on each core, at once, without a trainer. The limit is a bare Python
loop on each core. EnvPool steps the same tasks written in C++. Where all are stepped and awaited,
the trainer's process has one share (`placement: split`), unless it says *workers alone*.
"""

from __future__ import annotations

import os
from dataclasses import replace

from contenders import (
    Ceiling,
    EnvPool,
    GymnasiumAsync,
    Limit,
    OursAsync,
    OursSync,
    VectorEntryPoint,
    Work,
)
from harness import Contender, Question, Target, main

CORES = len(os.sched_getaffinity(0))
FIGURES = {
    # EnvPool's, all at a time and half at a time; the ceiling's; the limit's.
    ("HalfCheetah-v5", 32): (1.1, 1.0, None, None),
    ("HalfCheetah-v5", 64): (None, None, None, 1.1),
    ("HalfCheetah-v5", 256): (1.2, 1.1, 0.9, None),
    ("Ant-v5", 64): (1.15, None, None, None),
    ("Hopper-v5", 64): (1.05, None, None, None),
    ("Humanoid-v5", 64): (1.0, None, None, None),
}
"""What is asked of a task and a number of simulations, as ratios; None where nothing is."""

contenders: list[Contender] = []
targets: list[Target] = []


def against(subject: Contender, reference: Contender, bound: float) -> None:
    """Have both take part, each once, and compare them."""
    for one in (subject, reference):
        if one.name not in [other.name for other in contenders]:
            contenders.append(one)
    targets.append(Target(subject.name, reference.name, bound))


for (task, count), (pool, half_of_pool, ceiling, limit) in FIGURES.items():
    name = f"{task.removesuffix('-v5')} x {count}"
    plain = Work(task, count, backend="mujoco")
    work = replace(plain, together=count // CORES, placement="split")
    ours = OursSync(f"rlightning_aio, {name}", work)
    if pool:
        against(ours, EnvPool(f"EnvPool, {name}", plain), pool)
    if half_of_pool:
        half = count // 2
        # Two for each worker: while the trainer has one, it steps the other.
        halves = replace(plain, together=count // (2 * CORES))
        at_once = OursAsync(f"rlightning_aio, {half} of {name}", halves, min_results=CORES)
        against(at_once, EnvPool(f"EnvPool, {half} of {name}", plain, half), half_of_pool)
    if ceiling:
        loops = Ceiling(f"the ceiling, {name}", plain, num_envs=count // CORES)
        against(ours, loops, ceiling)
    if limit:
        against(ours, Limit(f"the limit, {name}", plain), limit)

cheetahs = Work("HalfCheetah-v5", 32, backend="mujoco")
together = replace(cheetahs, together=32 // CORES)
contenders.append(OursSync("rlightning_aio, workers alone, HalfCheetah x 32", together))
contenders.append(OursSync("rlightning_aio, workers alone, 32 single HalfCheetahs", cheetahs))
cheetahs = replace(cheetahs, placement="split")
single = OursSync("rlightning_aio, 32 single HalfCheetahs", cheetahs)
against(single, GymnasiumAsync("Gymnasium AsyncVectorEnv, 32 HalfCheetahs", cheetahs), 4.0)
against(single, Limit("the limit, single HalfCheetahs", cheetahs), 0.75)

carts = Work("CartPole-v1", 1024, together=1024 // CORES, placement="split")
against(
    OursSync("rlightning_aio, CartPole x 1,024", carts),
    VectorEntryPoint("Gymnasium's vector_entry_point, CartPole x 1,024", carts),
    1.2,
)
# The same loop with the runtime around it: what that costs, and what wake-ups would.
inline = replace(carts, together=1024, placement="inline")
contenders.append(OursSync("rlightning_aio inline, CartPole x 1,024", inline))

QUESTION = Question(
    name="batches",
    title="Many simulations to a worker",
    unit="env steps/s",
    contenders=contenders,
    targets=targets,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
