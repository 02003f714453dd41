"""Awaitable envs: their rate, the cost of a step for the trainer, and their memory.

1,000 envs whose steps wait for 20 to 500 ms (log-normal) run on the trainer's event loop, as
`asyncio.gather` over episodes, in threads, and in one process each. The ideal rate is that of envs
that never wait for the trainer. Prints one JSON line for each way.

    python benchmarks/awaitable.py [--envs 1000] [--seconds 20] [--ways loop,gather,threads,process]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import resource
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import psutil
from gymnasium import spaces

import rlightning_aio as rl

MIN_RESULTS = 32
_DRAW = np.random.default_rng(0)
LATENCIES = np.clip(_DRAW.lognormal(np.log(0.08), 0.7, 100_003), 0.02, 0.5).tolist()
"""Durations of steps in seconds, drawn beforehand; each env begins at another position."""
MEAN = sum(LATENCIES) / len(LATENCIES)


class Waiting:
    """A step waits and does nothing else."""

    observation_space = spaces.Box(-1, 1, (8,), np.float32)
    action_space = spaces.Discrete(4)
    idle = np.zeros(8, np.float32)

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place = 97 * (seed or 0)
        return self.idle, {}

    async def step(self, action: Any) -> Any:
        del action
        await asyncio.sleep(self.latency())
        return self.idle, 1.0, False, False, {}

    def latency(self) -> float:
        self.place = (self.place + 1) % len(LATENCIES)
        return LATENCIES[self.place]


def processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def memory() -> int:
    """Return the memory in bytes of this process and its descendants."""
    own = psutil.Process()
    return sum(one.memory_info().rss for one in [own, *own.children(recursive=True)])


async def with_group(placement: str, count: int, seconds: float) -> dict[str, Any]:
    before, began = memory(), time.perf_counter()
    fields = {"envs_per_process": 1} if placement == "process" else {}
    config = rl.EnvConfig(
        name="w",
        make_env=Waiting,
        num_workers=count,
        placement=placement,
        start_timeout=600,
        **fields,
    )
    async with rl.build_env_group(config) as group:
        start_seconds = time.perf_counter() - began
        batch, _ = await group.reset(seed=0)
        held = memory() - before
        action = np.zeros(count, np.int64)
        steps, spent = 0, processor_seconds()
        group.step_async(batch.respond(action=action))
        began = time.perf_counter()
        while time.perf_counter() < began + seconds:
            batch, _ = await group.collect_async(min_results=MIN_RESULTS)
            group.step_async(batch.respond(action=action[: len(batch)]))
            steps += len(batch)
        elapsed = time.perf_counter() - began
        spent = processor_seconds() - spent
    return {
        "rate": steps / elapsed,
        "trainer_us_per_step": 1e6 * spent / steps,
        "start_seconds": start_seconds,
        "bytes_per_env": held / count,
    }


async def with_gather(count: int, seconds: float) -> dict[str, Any]:
    """Run one coroutine for each env, as OpenEnv recommends."""
    envs = [Waiting() for _ in range(count)]
    steps, spent, began = 0, processor_seconds(), time.perf_counter()

    async def episode(env: Waiting, seed: int) -> None:
        nonlocal steps
        await env.reset(seed=seed)
        while time.perf_counter() < began + seconds:
            await env.step(0)
            steps += 1

    await asyncio.gather(*(episode(env, k) for k, env in enumerate(envs)))
    elapsed = time.perf_counter() - began
    return {
        "rate": steps / elapsed,
        "trainer_us_per_step": 1e6 * (processor_seconds() - spent) / steps,
    }


def with_threads(count: int, seconds: float) -> dict[str, Any]:
    """Run one thread for each env, which sleeps."""
    before, began = memory(), time.perf_counter()
    spent = processor_seconds()

    def episode(seed: int) -> int:
        env, steps = Waiting(), 0
        env.place = 97 * seed
        while time.perf_counter() < began + seconds:
            time.sleep(env.latency())
            steps += 1
        return steps

    with ThreadPoolExecutor(count) as pool:
        running = [pool.submit(episode, k) for k in range(count)]
        start_seconds = time.perf_counter() - began
        held = memory() - before
        steps = sum(one.result() for one in running)
    elapsed = time.perf_counter() - began
    return {
        "rate": steps / elapsed,
        "trainer_us_per_step": 1e6 * (processor_seconds() - spent) / steps,
        "start_seconds": start_seconds,
        "bytes_per_env": held / count,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=50, help="envs of the way `process`")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--ways", default="loop,gather,threads,process")
    arguments = parser.parse_args()
    for way in arguments.ways.split(","):
        count = arguments.processes if way == "process" else arguments.envs
        if way in ("loop", "process"):
            found = rl.run(with_group(way, count, arguments.seconds))
        elif way == "gather":
            found = rl.run(with_gather(count, arguments.seconds))
        else:
            found = with_threads(count, arguments.seconds)
        found["of_ideal"] = found["rate"] * MEAN / count
        print(json.dumps({"way": way, "envs": count, **{k: round(v, 3) for k, v in found.items()}}))


if __name__ == "__main__":
    main()
