"""Processor time of the trainer: does it grow with the envs, and what does the kernel save?

Processor time of the trainer's process by env step, for 8 and for 1,024 envs: all of them by
`step`, ready ones by `collect_async`, and `collect_async` limited to 8 results, where the
other 1,016 envs must cost nothing. Then by batch of 32 HalfCheetahs, whose workers keep all cores
busy, with the compiled kernel and without: a trainer that runs between busy simulators finds its
caches cold.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import no_work
from contenders import OursAsync, OursSync, Work
from harness import Question, Target, main

NUM_WORKERS = 4
FEW, MANY = 8, 1024


def _work(num_envs: int) -> Work:
    return Work(no_work.NO_WORK, num_envs, modules=("no_work",))


@dataclass
class SyncCpu(OursSync):
    """Processor time for `per` steps, in µs."""

    per: int = 1

    def round(self, seconds: float) -> float:
        busy = time.process_time()
        until = time.perf_counter() + seconds
        count = 0
        while time.perf_counter() < until:
            count += self.step()
        return self.per * 1e6 * (time.process_time() - busy) / count


@dataclass
class AsyncCpu(OursAsync):
    async def measure(self, seconds: float) -> float:
        busy = time.process_time()
        count = await self.collect(seconds)
        return 1e6 * (time.process_time() - busy) / count


def _sync(num_envs: int) -> SyncCpu:
    return SyncCpu(f"sync, {num_envs} envs", _work(num_envs), num_envs // NUM_WORKERS, False)


def _first_ready(num_envs: int) -> AsyncCpu:
    name = f"async, first ready, {num_envs} envs"
    return AsyncCpu(name, _work(num_envs), num_envs // NUM_WORKERS, False)


def _eights(num_envs: int) -> AsyncCpu:
    name = f"async, batches of 8, {num_envs} envs"
    work = _work(num_envs)
    return AsyncCpu(name, work, num_envs // NUM_WORKERS, False, min_results=8, max_results=8)


def _cheetahs(name: str, implementation: str) -> SyncCpu:
    work = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")
    return SyncCpu(f"batch of 32, {name}", work, implementation=implementation, per=32)


COMPILED, TWINS = _cheetahs("compiled kernel", "c"), _cheetahs("Python twins", "python")
KINDS = (_sync, _first_ready, _eights)

QUESTION = Question(
    name="trainer_cpu",
    title=f"Trainer's CPU time: envs without work in {NUM_WORKERS} workers; 32 HalfCheetahs",
    unit="µs by env step or batch",
    contenders=[
        *(kind(num_envs) for kind in KINDS for num_envs in (FEW, MANY)),
        COMPILED,
        TWINS,
    ],
    targets=[
        *(Target(kind(MANY).name, kind(FEW).name, 1.0, at_most=True) for kind in KINDS),
        Target(COMPILED.name, TWINS.name, 0.5, at_most=True),
    ],
    seconds=1.0,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
