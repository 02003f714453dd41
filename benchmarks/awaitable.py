"""Envs that wait: their rate, what a step costs the trainer, their memory and their start-up.

Steps wait for 20 to 500 ms (log-normal, `waiting.py`) and do nothing else. They run on the
trainer's event loop (`placement: loop`), as `asyncio.gather` over episodes, in a thread each, and
in a worker process each. The ideal rate is that of envs that never wait for anybody else. A group
collects batches of whatever is ready, a 32nd of its envs at least; `gather` and threads have no
batches. Memory is the proportional set size of all processes. Start-up ends with the first
observation of every env. Both are measured once, in a fresh process.

There are 100 processes: 1,000 would need 19 GiB, and a minute to start on two cores.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from harness import (
    Contender,
    Load,
    arguments,
    machine_facts,
    machine_text,
    modules_of,
    number_text,
    take_turns,
)
from memory import resident_kib
from waiting import MEAN, Awaiting, Sleeping

import rlightning_aio as rl
from rlightning_aio.cli.measurement import Figures

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

ENVS, PROCESSES, MANY, AGENTS = 1000, 100, 10_000, 2000
ROUNDS, SECONDS = 5, 8.0
SHARE, RATE, TRAINER = "share of the ideal rate", "env steps/s", "trainer, µs/step"
ALL, START, MEMORY = "all processes, µs/step", "start-up, s", "KiB/env"
COLUMNS = (SHARE, RATE, TRAINER, ALL, START, MEMORY)


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
        self.start()
        self.start_seconds = time.perf_counter() - began
        self.kib = (resident_kib() - before) / self.count

    def round(self, seconds: float) -> dict[str, float]:
        """Return the figures; `ALL` is to be multiplied by the number of busy processors."""
        spent, began = self.spent(), time.perf_counter()
        rate, steps = self.play(seconds)
        return {
            ALL: 1e6 * (time.perf_counter() - began) / steps,
            SHARE: rate * MEAN / self.count,
            RATE: rate,
            TRAINER: 1e6 * (self.spent() - spent) / steps,
            START: self.start_seconds,
            MEMORY: self.kib,
        }

    def start(self) -> None:
        """Start all envs; returns when every one has its first observation."""
        raise NotImplementedError

    def play(self, seconds: float) -> tuple[float, int]:
        """Step for about so long.

        Returns the steps per second, and the number of steps, with those that end afterwards.
        """
        raise NotImplementedError

    def spent(self) -> float:
        """Return the processor time of the trainer's thread."""
        return time.thread_time()

    def teardown(self) -> None:
        self.runner.close()


@dataclass
class InGroup(Way):
    make_env: Callable[[], Any]
    placement: str
    envs_per_process: int = 1

    def start(self) -> None:
        self.runner.run(self._start())

    async def _start(self) -> None:
        entry: dict[str, Any] = {"name": "w", "task": self.make_env, "num_workers": self.count}
        entry |= {"placement": self.placement, "start_timeout": 600}
        if self.placement == "process":
            entry["envs_per_process"] = self.envs_per_process
        self.group = rl.build_env_group(entry)
        await self.group.init()
        self.batch, _ = await self.group.reset(seed=0)

    def play(self, seconds: float) -> tuple[float, int]:
        return self.runner.run(self._play(seconds))

    async def _play(self, seconds: float) -> tuple[float, int]:
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

    async def _start(self) -> None:
        await super()._start()
        self.episodes = [
            self.group.episode(env_id, seed=k) for k, env_id in enumerate(self.group.env_ids)
        ]
        await asyncio.gather(*(episode.__aenter__() for episode in self.episodes))

    async def _play(self, seconds: float) -> tuple[float, int]:
        steps = await steps_of_all(self.episodes, seconds)
        return steps / seconds, steps + self.count


@dataclass
class Gather(Way):
    """One coroutine for each env, as OpenEnv recommends."""

    def start(self) -> None:
        self.envs = [Awaiting() for _ in range(self.count)]
        self.runner.run(self._start())

    async def _start(self) -> None:
        await asyncio.gather(*(env.reset(seed=k) for k, env in enumerate(self.envs)))

    def play(self, seconds: float) -> tuple[float, int]:
        return self.runner.run(self._play(seconds))

    async def _play(self, seconds: float) -> tuple[float, int]:
        steps = await steps_of_all(self.envs, seconds)
        return steps / seconds, steps + self.count


@dataclass
class Threads(Way):
    """One thread for each env, which sleeps."""

    def start(self) -> None:
        self.envs = [Sleeping() for _ in range(self.count)]
        self.pool = ThreadPoolExecutor(self.count)
        here = threading.Barrier(self.count + 1)

        def begin(k: int) -> None:
            self.envs[k].reset(seed=k)
            here.wait()

        for k in range(self.count):
            self.pool.submit(begin, k)
        here.wait()

    def play(self, seconds: float) -> tuple[float, int]:
        until = time.perf_counter() + seconds

        def episode(env: Sleeping) -> int:
            steps = 0
            env.step(0)
            while time.perf_counter() < until:
                steps += 1
                env.step(0)
            return steps

        steps = sum(self.pool.map(episode, self.envs))
        return steps / seconds, steps + self.count

    def spent(self) -> float:
        """Return the processor time of all threads."""
        return time.process_time()

    def teardown(self) -> None:
        self.pool.shutdown()
        super().teardown()


OURS, OURS_MANY = f"placement: loop, {ENVS:,} envs", f"placement: loop, {MANY:,} envs"
AGENTS_HERE = f"a coroutine for each episode, placement: loop, {AGENTS:,} envs"
AGENTS_OF_WORKERS = f"a coroutine for each episode, placement: process, {AGENTS:,} envs"
WAYS: tuple[Contender, ...] = (
    InGroup(OURS, ENVS, Awaiting, "loop"),
    Gather(f"gather over episodes, {ENVS:,} envs", ENVS),
    Threads(f"a thread for each env, {ENVS:,} envs", ENVS),
    InGroup(f"a process for each env, {PROCESSES:,} envs", PROCESSES, Sleeping, "process"),
    InGroup(OURS_MANY, MANY, Awaiting, "loop"),
    Episodes(AGENTS_HERE, AGENTS, Awaiting, "loop"),
    Episodes(AGENTS_OF_WORKERS, AGENTS, Awaiting, "process", 500),
)
TARGETS = (
    (OURS, SHARE, "≥", 0.95),
    (OURS, TRAINER, "≤", 40),
    (OURS_MANY, START, "≤", 10),
    (AGENTS_HERE, TRAINER, "≤", 60),
    (AGENTS_OF_WORKERS, TRAINER, "≤", 60),
)


def figures_of(rounds: list[tuple[dict[str, float], Load]]) -> dict[str, Any]:
    """Return the median, lowest and highest of each figure of a way."""
    for values, load in rounds:
        values[ALL] *= load.cores
    columns = {name: [values[name] for values, _ in rounds] for name in COLUMNS}
    return {name: Figures(found).as_json() for name, found in columns.items()}


def tables(results: dict[str, Any]) -> str:
    lines = [f"| | {' | '.join(COLUMNS)} |", "|---" + "|---:" * len(COLUMNS) + "|"]
    for name, found in results.items():
        cells = (number_text(found[column]["median"]) for column in COLUMNS)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", "| target | | median | lowest to highest | |", "|---|---|---:|---:|---|"]
    for name, column, sign, bound in TARGETS:
        if name in results:
            found = results[name][column]
            low, median, high = (number_text(found[k]) for k in ("low", "median", "high"))
            is_met = found["median"] >= bound if sign == "≥" else found["median"] <= bound
            met = "met" if is_met else "missed"
            lines.append(
                f"| {name}: {column} | {sign} {bound} | {median} | {low} to {high} | {met} |"
            )
    return "\n".join(lines)


def main() -> None:
    given = arguments(__doc__, ROUNDS, SECONDS)
    machine = machine_facts(modules_of(WAYS))
    turns, skipped = take_turns(
        WAYS, given.rounds, given.seconds, given.only, lambda found: number_text(found[RATE])
    )
    results = {name: figures_of(rounds) for name, rounds in turns.items()}
    shown = tables(results)
    print(f"{shown}\n\n{machine_text(machine)}")
    if given.json:
        report: dict[str, Any] = {
            "name": "awaitable",
            "title": "Envs that wait",
            "unit": RATE,
            "rounds": given.rounds,
            "seconds": given.seconds,
            "machine": machine,
            "results": results,
            "targets": [],
            "skipped": skipped,
            "tables": shown,
        }
        given.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
