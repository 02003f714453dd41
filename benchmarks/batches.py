"""Many MuJoCo simulations in one process: faster than EnvPool, and close to a bare `mujoco.batch`?

All are stepped and awaited, or half of them at a time: while the trainer has one half, MuJoCo's
threads step the other. EnvPool steps the same tasks, rewritten in C++. The bare loop writes
controls, steps, and reads positions and velocities, without rewards, ends, resets and infos.
"""

from __future__ import annotations

import os
from dataclasses import replace

from contenders import (
    BareBatch,
    EnvPool,
    GymnasiumAsync,
    MakeVec,
    OursAsync,
    OursSync,
    VectorEntryPoint,
    Work,
)
from harness import Contender, Question, Target, main

CORES = len(os.sched_getaffinity(0))
FIGURES = {
    ("HalfCheetah-v5", 32): (1.3, 1.1),
    ("HalfCheetah-v5", 256): (1.2, 1.15),
    ("Ant-v5", 64): (1.15, None),
    ("Hopper-v5", 64): (1.05, None),
    ("Walker2d-v5", 64): (1.05, None),
    ("Humanoid-v5", 64): (1.05, None),
}
"""The minimum ratios to EnvPool of a task and a number of simulations, for all at a time and half
at a time; None if half is not measured.
"""
OF_BARE = 0.93
"""The minimum ratio to the bare loop."""

contenders: list[Contender] = []
targets: list[Target] = []


def against(subject: Contender, reference: Contender, bound: float) -> None:
    """Let both take part, each once, and compare them."""
    for one in (subject, reference):
        if one.name not in [other.name for other in contenders]:
            contenders.append(one)
    targets.append(Target(subject.name, reference.name, bound))


for (task, count), (pool, half_of_pool) in FIGURES.items():
    name = f"{task.removesuffix('-v5')} x {count}"
    plain = Work(task, count, backend="mujoco")
    work = replace(plain, together=count, placement="inline")
    ours = OursSync(f"rlightning_aio, {name}", work, auto_reset=False)
    against(ours, EnvPool(f"EnvPool, {name}", plain), pool)
    against(ours, BareBatch(f"bare mujoco.batch, {name}", plain), OF_BARE)
    if half_of_pool:
        half = count // 2
        in_halves = replace(work, together=half)
        halves = OursAsync(f"rlightning_aio, {half} of {name}", in_halves, auto_reset=False)
        against(halves, EnvPool(f"EnvPool, {half} of {name}", plain, half), half_of_pool)
        bare = BareBatch(f"bare mujoco.batch, {half} of {name}", plain, half=True)
        against(halves, bare, OF_BARE)

cheetahs = Work("HalfCheetah-v5", 32, backend="mujoco")
made = MakeVec("make_vec, HalfCheetah x 32", cheetahs)
# Separate envs: what a field of a config entry makes of it.
former = MakeVec("make_vec in workers, HalfCheetah x 32", cheetahs, {"placement": "process"})
against(made, former, 1.5)
against(made, GymnasiumAsync("Gymnasium AsyncVectorEnv, 32 HalfCheetahs", cheetahs), 4.0)

carts = Work("CartPole-v1", 1024, together=1024 // CORES)
against(
    OursSync("rlightning_aio, CartPole x 1,024", carts),
    VectorEntryPoint("Gymnasium's vector_entry_point, CartPole x 1,024", carts),
    1.2,
)
# The same loop with the runtime around it, for the cost of the runtime and of wake-ups.
inline = replace(carts, together=1024, placement="inline")
contenders.append(OursSync("rlightning_aio inline, CartPole x 1,024", inline))

QUESTION = Question(
    name="batches",
    title="Many simulations in one process",
    unit="env steps/s",
    contenders=contenders,
    targets=targets,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
