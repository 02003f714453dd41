"""Attempts of agents while envs, agents and a model's server fail.

64 tasks are attempted 8 times each, on 256 awaitable envs, and on 16 envs in worker processes. Of
the attempts, 5 % each meet an env that raises, one that hangs, one whose process dies (in workers),
a reset that fails, an agent that is stuck, and a model's server that is away. `play` tries all but
stuck agents again. The report counts outcomes against what was injected.

Then 2,000 attempts of ten steps in flight, whose steps wait for a second on average on the event
loop, or for a tenth of it in worker processes (log-normal): how late the event loop is, with the
start of all of them, and what a step costs the trainer's thread, with its share of the starts and
ends.

    python benchmarks/attempts.py

A run that is killed ten times, and goes on from its file, is a test:

    RLIGHTNING_AIO_KILLS=10 python -m pytest tests/attempts/test_killed.py
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import random
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
from harness import machine_facts
from waiting import IDLE, MEAN, Waits

import rlightning_aio as rl
from rlightning_aio.attempts import AttemptGroup, EpisodeSpec, Rules, play
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import Iterator

TASKS, SIZE, STEPS, STEP_SECONDS = 64, 8, 4, 0.002
SHARE: Final = 0.05
FAULTS: Final = {
    "raises": ("env_raised", "either"),
    "hangs": ("env_hung", "either"),
    "dies": ("env_died", "env"),
    "fails to reset": ("not_started", "env"),
    "agent is stuck": ("timed_out", "either"),
    "server is away": ("agent_raised", "infrastructure"),
}
"""What goes wrong, and the outcome that is to say so."""
IN_FLIGHT, LONG = 2000, 10
FLIGHTS: Final = {"loop": 1.0, "process": 0.1}
"""Of attempts: the placement, and the mean seconds of a step."""


def fault_of(seed: int, index: int, faults: list[str]) -> str:
    """What goes wrong in the first try of an attempt; empty for nothing."""
    rng = random.Random(f"{seed}-{index}")
    number = int(rng.random() / SHARE)
    return faults[number] if number < len(faults) else ""


class Tool(gym.Env[Any, Any]):
    """Ends after some steps, each of which earns 1; an action may be a fault.

    A reset fails for each file of the folder in its options whose name begins with the seed.
    """

    observation_space = action_space = Anything()

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.steps = 0
        for file in Path(options["folder"]).glob(f"{seed}-*"):
            with contextlib.suppress(FileNotFoundError):  # Another attempt may have had it.
                file.unlink()
                raise RuntimeError("the tool could not be prepared")
        return {}, {}

    def step(self, action: Any) -> Any:
        if action == "raises":
            raise RuntimeError("the tool has failed")
        if action == "hangs":
            time.sleep(3600)
        if action == "dies":
            os._exit(3)
        self.steps += 1
        return {}, 1.0, self.steps == STEPS, False, {}


class AwaitedTool:
    """The same on an event loop."""

    observation_space = action_space = Anything()

    def __init__(self) -> None:
        self.tool = Tool()

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return self.tool.reset(seed=seed, options=options)

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(3600 if action == "hangs" else STEP_SECONDS)
        return self.tool.step(action)


class Agent:
    """Steps to the end; the first try of some attempts goes wrong."""

    def __init__(self, faults: dict[tuple[int, int], str]) -> None:
        self.faults = dict(faults)

    async def __call__(self, episode: Any) -> None:
        fault = self.faults.pop((episode.spec.seed, episode.index), "")
        await episode.step("go")
        if fault == "agent is stuck":
            await asyncio.Event().wait()
        if fault == "server is away":
            raise ConnectionError("the model's server is away")
        if fault in ("raises", "hangs", "dies"):
            await episode.step(fault)
        while not episode.is_over:
            await episode.step("go")


def entry(place: str) -> dict[str, Any]:
    """256 envs on the event loop, or 16 in workers of their own."""
    if place == "loop":
        return {"task": AwaitedTool, "placement": "loop", "num_workers": 256}
    return {"task": Tool, "envs_per_process": 1, "num_workers": 16}


async def played(
    place: str, tasks: list[EpisodeSpec], faults: dict[tuple[int, int], str]
) -> dict[str, Any]:
    """Play all attempts by `play`; return what was found."""
    found = Counter[str]()
    groups: list[AttemptGroup] = []
    lags: list[float] = []
    began = time.monotonic()
    rules = Rules(attempt_timeout=8, max_concurrency=256)
    agent = Agent({key: fault for key, fault in faults.items() if fault != "fails to reset"})
    limits: dict[str, Any] = {"step_timeout": 2.0, "max_restarts": 100}
    async with rl.build_env_group(name="tool", **entry(place), **limits) as group:
        watching = asyncio.create_task(watch(lags))
        async for attempts in play(group, tasks, agent, SIZE, rules):
            groups.append(attempts)
            for attempt in attempts:
                last = [attempt.outcome] if attempt.outcome.is_failure else []
                for outcome in [*attempt.failures, *last]:
                    found[f"{outcome.kind} ({outcome.blame})"] += 1
        watching.cancel()
        left = len(group.pending)
    left += len(asyncio.all_tasks() - {asyncio.current_task(), watching})
    rewards = Counter(attempt.reward for attempts in groups for attempt in attempts)
    return {
        "groups": len(groups),
        "complete": sum(attempts.is_complete for attempts in groups),
        "rewards": {str(reward): count for reward, count in rewards.items()},
        "failures": dict(sorted(found.items())),
        "left": left,
        "seconds": time.monotonic() - began,
        **lag_of(lags),
    }


async def watch(lags: list[float]) -> None:
    """Note how late the event loop is."""
    while True:
        began = time.monotonic()
        await asyncio.sleep(0.005)
        lags.append(time.monotonic() - began - 0.005)


def lag_of(lags: list[float]) -> dict[str, float]:
    lags.sort()
    return {"lag_p99_ms": 1e3 * lags[int(0.99 * len(lags))], "lag_max_ms": 1e3 * lags[-1]}


def injected(place: str, number: int) -> dict[str, Any]:
    """Inject faults into a run."""
    possible = [name for name in FAULTS if place == "workers" or name != "dies"]
    with tempfile.TemporaryDirectory() as folder:
        tasks = [EpisodeSpec("", seed, {"folder": folder}) for seed in range(number)]
        faults: dict[tuple[int, int], str] = {}
        for seed, index in itertools.product(range(number), range(SIZE)):
            if fault := fault_of(seed, index, possible):
                faults[seed, index] = fault
            if fault == "fails to reset":
                Path(folder, f"{seed}-{index}").touch()
        found = rl.run(played(place, tasks, faults))
    kinds = Counter("{} ({})".format(*FAULTS[fault]) for fault in faults.values())
    return {**found, "injected": dict(sorted(kinds.items()))}


class Waiting(Waits):
    """An awaitable env, whose steps wait for `mean` s on average."""

    def __init__(self, mean: float) -> None:
        self.mean = mean

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place, self.steps = 97 * (seed or 0), 0
        return IDLE, {}

    async def step(self, action: Any) -> Any:
        del action
        await asyncio.sleep(self.mean * self.latency() / MEAN)
        self.steps += 1
        return IDLE, 1.0, self.steps >= LONG, False, {}


async def many(number: int, seconds: float, placement: str, mean: float) -> dict[str, float]:
    """Keep a number of attempts in flight for some seconds; `mean` is that of a step."""
    steps, lags = 0, list[float]()

    async def agent(episode: Any) -> None:
        nonlocal steps
        while not episode.is_over:
            await episode.step(0)
            steps += 1

    def tasks() -> Iterator[EpisodeSpec]:
        until = time.monotonic() + seconds
        for seed in itertools.takewhile(lambda _: time.monotonic() < until, itertools.count()):
            yield EpisodeSpec("", seed)

    fields: dict[str, Any] = {"placement": placement, "step_timeout": 60}
    async with rl.build_env_group(
        Waiting, num_workers=number, env_kwargs={"mean": mean}, **fields
    ) as group:
        spent = time.thread_time()
        watching = asyncio.create_task(watch(lags))
        async for attempts in play(group, tasks(), agent, SIZE):
            assert attempts.is_complete
        watching.cancel()
        spent = time.thread_time() - spent
    return {**lag_of(lags), "us_per_step": 1e6 * spent / steps}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", type=int, default=TASKS)
    parser.add_argument("--seconds", type=float, default=10.0, help="of attempts in flight")
    parser.add_argument(
        "--in-flight", type=int, default=IN_FLIGHT, help="how many, 8 or a multiple"
    )
    args = parser.parse_args()
    report: dict[str, Any] = {"machine": machine_facts(("rlightning_aio", "uvloop"))}
    report |= {place: injected(place, args.tasks) for place in ("loop", "workers")}
    report["in_flight"] = {
        placement: rl.run(many(args.in_flight, args.seconds, placement, mean))
        for placement, mean in FLIGHTS.items()
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
