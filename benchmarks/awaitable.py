"""Envs that wait: their rate, what a step costs the trainer, their memory and their start-up.

Steps wait for 20 to 500 ms (log-normal, `waiting.py`) and do nothing else. They run on the
trainer's event loop (`placement: loop`), and as `asyncio.gather` over episodes. The ideal rate is
that of envs that never wait for anybody else. A group collects batches of whatever is ready, a 32nd
of its envs at least; `gather` has no batches, and no time limits. Memory is the proportional set
size of all processes. Start-up ends with the first observation of every env. Both are measured
once, in a fresh process. Agents' episodes are in `attempts.py`.
"""

from __future__ import annotations

import asyncio
import gc
import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from harness import Contender, Question, busy_ns, main
from waiting import MEAN, Awaiting

import rlightning_aio as rl
from rlightning_aio.cli.measurement import family, memory_bytes

ENVS, MANY = 1000, 10_000
SHARE, RATE, TRAINER = "share of the ideal rate", "env steps/s", "trainer, µs/step"
ALL, START, MEMORY = "all processes, µs/step", "start-up, s", "KiB/env"


def resident_kib() -> int:
    """Return the memory of this process and its descendants; shared pages count in part."""
    gc.collect()
    return memory_bytes(list(family(os.getpid()))) // 1024


@dataclass
class Way(Contender):
    """One way to run envs.

    Whoever inherits has `start`, which returns when every env has its first observation, and
    `play`, which steps them for about so long, and returns the steps per second, and the number of
    steps, with those that end afterwards.

    Attributes:
        count: number of envs.
    """

    name: str
    count: int

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "uvloop")

    def setup(self) -> None:
        import uvloop

        self.runner = asyncio.Runner(loop_factory=uvloop.new_event_loop)
        self.runner.get_loop()
        before, began = resident_kib(), time.perf_counter()
        self.runner.run(self.start())
        self.start_seconds = time.perf_counter() - began
        self.kib = (resident_kib() - before) / self.count

    def round(self, seconds: float) -> dict[str, float]:
        spent, busy = time.thread_time(), busy_ns(family(os.getpid()))
        rate, steps = self.runner.run(self.play(seconds))
        return {
            SHARE: rate * MEAN / self.count,
            RATE: rate,
            TRAINER: 1e6 * (time.thread_time() - spent) / steps,
            ALL: (busy_ns(family(os.getpid())) - busy) / 1e3 / steps,
            START: self.start_seconds,
            MEMORY: self.kib,
        }

    def teardown(self) -> None:
        self.runner.close()


@dataclass
class InGroup(Way):
    """A group's envs on the trainer's event loop."""

    async def start(self) -> None:
        limits: dict[str, Any] = {"start_timeout": 600, "step_timeout": 60}
        self.group = rl.build_env_group(
            Awaiting, num_workers=self.count, placement="loop", **limits
        )
        await self.group.init()
        self.batch, _ = await self.group.reset(seed=0)

    async def play(self, seconds: float) -> tuple[float, int]:
        group, steps, elapsed = self.group, 0, 0.0
        action, least = np.zeros(self.count, np.int64), self.count // 32
        began = time.perf_counter()
        group.step_async(self.batch.respond(action=action))
        while elapsed < seconds:
            batch, _ = await group.collect_async(min_results=least)
            steps += len(batch)
            elapsed = time.perf_counter() - began
            group.step_async(batch.respond(action=action[: len(batch)]))
        self.batch, _ = await group.collect_async(wait_all=True)
        return steps / elapsed, steps + self.count

    def teardown(self) -> None:
        self.runner.run(self.group.close())
        super().teardown()


@dataclass
class Gather(Way):
    """One coroutine for each env, as OpenEnv recommends."""

    async def start(self) -> None:
        self.envs = [Awaiting() for _ in range(self.count)]
        await asyncio.gather(*(env.reset(seed=k) for k, env in enumerate(self.envs)))

    async def play(self, seconds: float) -> tuple[float, int]:
        until = time.perf_counter() + seconds

        async def steps_of(env: Awaiting) -> int:
            """Step an env until it is time; do not count its first step."""
            steps = 0
            await env.step(0)
            while time.perf_counter() < until:
                steps += 1
                await env.step(0)
            return steps

        steps = sum(await asyncio.gather(*map(steps_of, self.envs)))
        return steps / seconds, steps + self.count


QUESTION = Question(
    name="awaitable",
    title="Envs that wait",
    unit=SHARE,
    columns=(SHARE, RATE, TRAINER, ALL, START, MEMORY),
    contenders=(
        InGroup(f"placement: loop, {ENVS:,} envs", ENVS),
        Gather(f"gather over episodes, {ENVS:,} envs", ENVS),
        InGroup(f"placement: loop, {MANY:,} envs", MANY),
    ),
    rounds=5,
    seconds=8.0,
)

if __name__ == "__main__":
    main([QUESTION], __doc__)
