"""Envs that wait: their rate, what a step costs the trainer, their memory and their start-up.

Steps wait for 20 to 500 ms (log-normal, `waiting.py`) and do nothing else. They run on the
trainer's event loop (`placement: loop`), in workers, and as `asyncio.gather` over episodes. The
ideal rate is that of envs that never wait for anybody else. A group collects batches of whatever is
ready, a 32nd of its envs at least; `gather` has no batches, and no time limits. Memory is the
proportional set size of all processes. Start-up ends with the first observation of every env. Both
are measured once, in a fresh process.
"""

from __future__ import annotations

import asyncio
import gc
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from harness import Contender, machine_facts, modules_of, number_text, parser_of, take_turns, tell
from waiting import MEAN, Awaiting

import rlightning_aio as rl
from rlightning_aio.cli.measurement import Figures, family, memory_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

ENVS, MANY, AGENTS = 1000, 10_000, 2000
ROUNDS, SECONDS = 5, 8.0
SHARE, RATE, TRAINER = "share of the ideal rate", "env steps/s", "trainer, µs/step"
ALL, START, MEMORY = "all processes, µs/step", "start-up, s", "KiB/env"
COLUMNS = (SHARE, RATE, TRAINER, ALL, START, MEMORY)


def resident_kib() -> int:
    """Return the memory of this process and its descendants; shared pages count in part."""
    gc.collect()
    return memory_bytes(list(family(os.getpid()))) // 1024


@dataclass
class Way(Contender):
    """One way to run envs.

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
        """Return the figures; `ALL` is to be multiplied by the number of busy processors."""
        spent, began = time.thread_time(), time.perf_counter()
        rate, steps = self.runner.run(self.play(seconds))
        return {
            ALL: 1e6 * (time.perf_counter() - began) / steps,
            SHARE: rate * MEAN / self.count,
            RATE: rate,
            TRAINER: 1e6 * (time.thread_time() - spent) / steps,
            START: self.start_seconds,
            MEMORY: self.kib,
        }

    async def start(self) -> None:
        """Start all envs; returns when every one has its first observation."""
        raise NotImplementedError

    async def play(self, seconds: float) -> tuple[float, int]:
        """Step for about so long.

        Returns the steps per second, and the number of steps, with those that end afterwards.
        """
        raise NotImplementedError

    def teardown(self) -> None:
        self.runner.close()


@dataclass
class InGroup(Way):
    placement: str
    envs_per_process: int = 1

    async def start(self) -> None:
        entry: dict[str, Any] = {"name": "w", "task": Awaiting, "num_workers": self.count}
        entry |= {"placement": self.placement, "start_timeout": 600, "step_timeout": 60}
        if self.placement == "process":
            entry["envs_per_process"] = self.envs_per_process
        self.group = rl.build_env_group(entry)
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


async def steps_of_all(envs: Sequence[Any], seconds: float) -> int:
    """Step each of `envs` in a coroutine of its own; count all steps but the first of each."""
    until = time.perf_counter() + seconds

    async def play(env: Any) -> int:
        steps = 0
        await env.step(0)
        while time.perf_counter() < until:
            steps += 1
            await env.step(0)
        return steps

    return sum(await asyncio.gather(*map(play, envs)))


@dataclass
class Episodes(InGroup):
    """A coroutine for each env of the group, which plays one episode of it."""

    async def start(self) -> None:
        await super().start()
        self.episodes = [
            self.group.episode(env_id, seed=k) for k, env_id in enumerate(self.group.env_ids)
        ]
        await asyncio.gather(*(episode.__aenter__() for episode in self.episodes))

    async def play(self, seconds: float) -> tuple[float, int]:
        steps = await steps_of_all(self.episodes, seconds)
        return steps / seconds, steps + self.count


@dataclass
class Gather(Way):
    """One coroutine for each env, as OpenEnv recommends."""

    async def start(self) -> None:
        self.envs = [Awaiting() for _ in range(self.count)]
        await asyncio.gather(*(env.reset(seed=k) for k, env in enumerate(self.envs)))

    async def play(self, seconds: float) -> tuple[float, int]:
        steps = await steps_of_all(self.envs, seconds)
        return steps / seconds, steps + self.count


OURS, OURS_MANY = f"placement: loop, {ENVS:,} envs", f"placement: loop, {MANY:,} envs"
AGENTS_HERE = f"a coroutine for each episode, placement: loop, {AGENTS:,} envs"
AGENTS_OF_WORKERS = f"a coroutine for each episode, placement: process, {AGENTS:,} envs"
WAYS: tuple[Contender, ...] = (
    InGroup(OURS, ENVS, "loop"),
    Gather(f"gather over episodes, {ENVS:,} envs", ENVS),
    InGroup(OURS_MANY, MANY, "loop"),
    Episodes(AGENTS_HERE, AGENTS, "loop"),
    Episodes(AGENTS_OF_WORKERS, AGENTS, "process", 500),
)


def figures_of(rounds: list[tuple[dict[str, float], float]]) -> dict[str, Any]:
    """Return the median, lowest and highest of each figure of a way."""
    for values, cores in rounds:
        values[ALL] *= cores
    columns = {name: [values[name] for values, _ in rounds] for name in COLUMNS}
    return {name: Figures(found).as_json() for name, found in columns.items()}


def tables(results: dict[str, Any]) -> str:
    lines = [f"| | {' | '.join(COLUMNS)} |", "|---" + "|---:" * len(COLUMNS) + "|"]
    for name, found in results.items():
        cells = (number_text(found[column]["median"]) for column in COLUMNS)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    given = parser_of(__doc__, ROUNDS, SECONDS).parse_args()
    turns, skipped = take_turns(WAYS, given, lambda found: found[RATE])
    results = {name: figures_of(rounds) for name, rounds in turns.items()}
    report = {
        "name": "awaitable",
        "title": "Envs that wait",
        "rounds": given.rounds,
        "seconds": given.seconds,
        "machine": machine_facts(modules_of(WAYS)),
        "results": results,
        "targets": [],
        "skipped": skipped,
        "tables": tables(results),
    }
    tell(report, given)


if __name__ == "__main__":
    main()
