"""4 workers, envs without work: does the trainer's processor time per step grow with the envs?

Processor time of the trainer's process by env step, for 8 and for 1,024 envs: all of them by
`step`, ready ones by `collect_async`, and `collect_async` limited to 8 results, where the
other 1,016 envs must cost nothing.
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
    def round(self, seconds: float) -> float:
        busy = time.process_time()
        until = time.perf_counter() + seconds
        count = 0
        while time.perf_counter() < until:
            count += self.step()
        return 1e6 * (time.process_time() - busy) / count


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


KINDS = (_sync, _first_ready, _eights)

QUESTION = Question(
    name="trainer_cpu",
    title=f"Trainer's CPU time, envs without work in {NUM_WORKERS} workers",
    unit="µs/env step",
    contenders=[kind(num_envs) for kind in KINDS for num_envs in (FEW, MANY)],
    targets=[Target(kind(MANY).name, kind(FEW).name, 1.0, at_most=True) for kind in KINDS],
    seconds=1.0,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
