"""Attempts of agents while envs, agents and a model's server fail: `play`, and `asyncio.gather`.

64 tasks are attempted 8 times each, on 256 awaitable envs, and on 16 envs in worker processes. Of
the attempts, 5 % each meet an env that raises, one that hangs, one whose process dies (in workers),
a reset that fails, an agent that is stuck, and a model's server that is away. `play` tries those
again. The table counts outcomes against what was injected; `gather` is the same program without it:
a loop over the tasks, an env for each attempt, no time limits.

Then the first 6 of 8 attempts whose latencies are log-normal, against waiting for all 8, and how
long it takes until the env of a surplus attempt plays the next; and how long after its cancellation
in a step that never ends an env is free, and has begun another episode, at each place.

Then 2,000 attempts of ten steps in flight, whose steps wait for a second on average, or for a tenth
of it (log-normal), on the event loop and in worker processes: how late the event loop is, with the
start of all of them, what a step costs the trainer's thread, with its share of the starts and ends,
and the garbage collector's pauses; as it is, and after `gc.collect(); gc.freeze()`, which leaves
out what exists already. And what a step costs whose
result comes all alone, while the other attempts wait; and the memory of an attempt.

    python benchmarks/attempts.py [--ray] [--json]

A run that is killed ten times, and goes on from its file, is a test:

    RLIGHTNING_AIO_KILLS=10 python -m pytest tests/attempts/test_killed.py
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
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
import psutil
from harness import machine_facts, machine_text
from waiting import IDLE, MEAN, Waits

import rlightning_aio as rl
from rlightning_aio.attempts import AttemptGroup, EpisodeSpec, Rules, play
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

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
GIVE_UP_SECONDS: Final = 20.0
MEDIAN_SECONDS, IN_FLIGHT, LONG, CUT = 0.05, 2000, 10, 5
FLIGHTS: Final = (
    ("loop", 1.0, False),
    ("loop", 1.0, True),
    ("loop", 0.1, False),
    ("process", 0.1, False),
)
"""Of attempts: the placement, seconds of a step, and whether `gc.freeze` is called before."""
WAIT, AT_ONCE, FOREVER = range(3)
"""For how long a step waits."""


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
        await self.play(episode, self.faults.pop((episode.spec.seed, episode.index), ""))

    async def play(self, episode: Any, fault: str) -> None:
        """Play one try."""
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


async def ours(
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
                for outcome in attempt.failures:
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
        "lag_p99_ms": 1e3 * sorted(lags)[int(0.99 * len(lags))],
    }


async def watch(lags: list[float]) -> None:
    """Note how late the event loop is."""
    while True:
        began = time.monotonic()
        await asyncio.sleep(0.005)
        lags.append(time.monotonic() - began - 0.005)


async def gathered(
    place: str, tasks: list[EpisodeSpec], faults: dict[tuple[int, int], str]
) -> dict[str, Any]:
    """Play them by a coroutine for each env, which `asyncio.gather` waits for."""
    jobs = [(spec, index) for spec in tasks for index in range(SIZE)]
    agent, ended = Agent({}), 0

    async def player(group: rl.EnvGroup, env_id: str) -> None:
        nonlocal ended
        while jobs:
            spec, index = jobs.pop()
            async with group.episode(env_id, spec.seed, dict(spec.options or {})) as episode:
                await agent.play(episode, faults.get((spec.seed, index), ""))
            ended += 1

    end = "ended"
    async with rl.build_env_group(name="tool", **entry(place)) as group:
        try:
            async with asyncio.timeout(GIVE_UP_SECONDS):
                await asyncio.gather(*(player(group, env_id) for env_id in group.env_ids))
        except TimeoutError:
            end = f"hung: given up after {GIVE_UP_SECONDS:g} s"
        except Exception as error:  # noqa: BLE001  # Whatever it is, it ends the run.
            end = f"ended by {type(error).__name__}"
    return {"end": end, "attempts": ended}


def compared(place: str, number: int) -> dict[str, Any]:
    """Inject faults into a run of each program."""
    possible = [name for name in FAULTS if place == "workers" or name != "dies"]
    found: dict[str, Any] = {}
    for name, program in (("play", ours), ("gather", gathered)):
        with tempfile.TemporaryDirectory() as folder:
            tasks = [EpisodeSpec("", seed, {"folder": folder}) for seed in range(number)]
            faults = {
                (spec.seed, index): fault
                for spec in tasks
                for index in range(SIZE)
                if (fault := fault_of(spec.seed, index, possible))
            }
            for spec in tasks:
                for index in range(SIZE):
                    if faults.get((spec.seed, index)) == "fails to reset":
                        Path(folder, f"{spec.seed}-{index}").touch()
            found[name] = rl.run(program(place, tasks, faults))
    kinds = Counter("{} ({})".format(*FAULTS[fault]) for fault in faults.values())
    found["injected"] = dict(sorted(kinds.items()))
    return found


class Slow(AwaitedTool):
    """Each step takes as long as its action says."""

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(action)
        return self.tool.step(action)


async def first_of(first: int | None, number: int) -> dict[str, Any]:
    """Play groups of 8 on 8 envs, one after another, with the same latencies for each rule."""
    cancelled: dict[str, float] = {}
    freed: list[float] = []

    async def agent(episode: Any) -> None:
        if (since := cancelled.pop(episode.env_id, None)) is not None:
            freed.append(time.monotonic() - since)
        rng = random.Random(f"{episode.spec.seed}-{episode.index}")
        try:
            while not episode.is_over:
                await episode.step(MEDIAN_SECONDS * rng.lognormvariate(0.0, 1.0))
        except asyncio.CancelledError:
            cancelled[episode.env_id] = time.monotonic()
            raise

    tasks = [EpisodeSpec("", seed, {"folder": "/"}) for seed in range(number)]
    async with rl.build_env_group(Slow, num_workers=SIZE, placement="loop") as group:
        began = time.monotonic()
        for task in tasks:
            async for attempts in play(group, [task], agent, SIZE, Rules(first=first)):
                assert attempts.is_complete
        seconds = time.monotonic() - began
    return {"seconds_per_group": seconds / number, "freed_s": max(freed, default=None)}


async def until_free(fields: dict[str, Any]) -> dict[str, float]:
    """Cancel episodes in a step that never ends: the longest time until their env is free again.

    And until it has begun another episode, for which most are built anew.
    """
    free: list[float] = []
    begun: list[float] = []
    async with rl.build_env_group(name="tool", num_workers=1, **fields) as group:
        (env_id,) = group.env_ids
        for _ in range(CUT):
            async with group.episode(env_id, options={"folder": "/"}) as episode:
                step = asyncio.ensure_future(episode.step("hangs"))
                await asyncio.sleep(0.1)
                step.cancel()
                await asyncio.wait({step})
                began = time.monotonic()
            free.append(time.monotonic() - began)
            async with group.episode(env_id, options={"folder": "/"}):
                begun.append(time.monotonic() - began)
    return {"free_s": max(free), "begun_s": max(begun)}


async def until_free_everywhere(*, ray: bool) -> dict[str, dict[str, float]]:
    """`until_free` at each place."""
    worker: dict[str, Any] = {"task": Tool, "envs_per_process": 1}
    places = {
        "loop": {"task": AwaitedTool, "placement": "loop"},
        "awaitable in a worker": {"task": AwaitedTool},
        "worker": worker,
    }
    if ray:
        places["ray"] = {**worker, "placement": "ray", "num_cpus": 0, "start_timeout": 300.0}
    return {name: await until_free(fields) for name, fields in places.items()}


class Waiting(Waits):
    """An awaitable env, whose steps wait as long as they are told, or for `mean` s on average."""

    steps = 0

    def __init__(self, mean: float = 1.0) -> None:
        self.mean = mean

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place, self.steps = 97 * (seed or 0), 0
        return IDLE, {}

    async def step(self, action: Any) -> Any:
        await asyncio.sleep((self.mean * self.latency() / MEAN, 0, 3600)[action])
        self.steps += 1
        return IDLE, 1.0, self.steps >= LONG and action == WAIT, False, {}


@contextlib.contextmanager
def collector_pauses() -> Generator[list[float]]:
    """How long each run of the garbage collector takes, in seconds of the thread."""
    pauses: list[float] = []
    began = 0.0

    def note(phase: str, info: dict[str, int]) -> None:
        nonlocal began
        del info
        if phase == "start":
            began = time.thread_time()
        else:
            pauses.append(time.thread_time() - began)

    gc.callbacks.append(note)
    yield pauses
    gc.callbacks.remove(note)


async def many(
    number: int, seconds: float, placement: str, mean: float, *, freezes: bool
) -> dict[str, float]:
    """Keep a number of attempts in flight for some seconds; `mean` is that of a step."""
    steps, lags = 0, list[float]()

    async def agent(episode: Any) -> None:
        nonlocal steps
        while not episode.is_over:
            await episode.step(WAIT)
            steps += 1

    def tasks() -> Iterator[EpisodeSpec]:
        until = time.monotonic() + seconds
        for seed in itertools.takewhile(lambda _: time.monotonic() < until, itertools.count()):
            yield EpisodeSpec("", seed)

    async with rl.build_env_group(
        Waiting, num_workers=number, placement=placement, env_kwargs={"mean": mean}
    ) as group:
        gc.collect()
        if freezes:
            gc.freeze()
        spent = time.thread_time()
        watching = asyncio.create_task(watch(lags))
        with collector_pauses() as pauses:
            async for attempts in play(group, tasks(), agent, SIZE):
                assert attempts.is_complete
        watching.cancel()
        spent = time.thread_time() - spent
    gc.unfreeze()
    lags.sort()
    return {
        "lag_p99_ms": 1e3 * lags[int(0.99 * len(lags))],
        "lag_max_ms": 1e3 * lags[-1],
        "us_per_step": 1e6 * spent / steps,
        "longest_collection_ms": 1e3 * max(pauses, default=0.0),
    }


async def alone(number: int, steps: int) -> float:
    """What a step of one attempt costs the thread while the others wait, in µs."""
    begun, all_begun = 0, asyncio.Event()
    found: asyncio.Future[float] = asyncio.get_running_loop().create_future()

    async def agent(episode: Any) -> None:
        nonlocal begun
        begun += 1
        if begun == number:
            all_begun.set()
        if episode.spec.seed or episode.index:
            await episode.step(FOREVER)
        await all_begun.wait()
        await asyncio.sleep(1.0)  # Until the steps of the others were sent.
        costs: list[float] = []
        for _ in range(5):
            began = time.thread_time()
            for _ in range(steps):
                await episode.step(AT_ONCE)
            costs.append(1e6 * (time.thread_time() - began) / steps)
        found.set_result(min(costs))

    async with rl.build_env_group(Waiting, num_workers=number, placement="loop") as group:
        tasks = [EpisodeSpec("", seed) for seed in range(number // SIZE)]
        playing = asyncio.ensure_future(anext(groups := play(group, tasks, agent, SIZE)))
        cost = await found
        playing.cancel()
        await asyncio.wait([playing])
        await groups.aclose()
    return cost


async def memory_of_attempts() -> float:
    """KiB of an attempt and its agent in its first step, without those of its env."""
    flying, all_there, go = 0, asyncio.Event(), asyncio.Event()

    async def agent(episode: Any) -> None:
        nonlocal flying
        await episode.step("go")
        flying += 1
        if flying == IN_FLIGHT:
            all_there.set()
        await go.wait()

    async with rl.build_env_group(AwaitedTool, num_workers=IN_FLIGHT, placement="loop") as group:
        await group.reset(options={"folder": "/"})
        before = psutil.Process().memory_info().rss
        tasks = [EpisodeSpec("", seed, {"folder": "/"}) for seed in range(IN_FLIGHT // SIZE)]
        groups = play(group, tasks, agent, SIZE)
        waiting = asyncio.ensure_future(anext(groups))
        await all_there.wait()
        used = psutil.Process().memory_info().rss - before
        go.set()
        await waiting
        await groups.aclose()
    return used / 1024 / IN_FLIGHT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=int, default=TASKS)
    parser.add_argument("--ray", action="store_true", help="cancel episodes on Ray, too")
    parser.add_argument("--seconds", type=float, default=10.0, help="of attempts in flight")
    parser.add_argument(
        "--in-flight", type=int, default=IN_FLIGHT, help="how many, 8 or a multiple"
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    args = parser.parse_args()
    report = {place: compared(place, args.tasks) for place in ("loop", "workers")}
    rules = {f"first {k or SIZE}": rl.run(first_of(k, min(args.tasks, 32))) for k in (None, 6)}
    freed = asyncio.run(until_free_everywhere(ray=args.ray))
    memory = rl.run(memory_of_attempts())  # Before others have used and freed as much.
    flights = {
        f"{placement}, steps of {mean:g} s{', frozen' if freezes else ''}": rl.run(
            many(args.in_flight, args.seconds, placement, mean, freezes=freezes)
        )
        for placement, mean, freezes in FLIGHTS
    }
    more = {
        **rules,
        "freed": freed,
        "in_flight": flights,
        "alone_us_per_step": rl.run(alone(args.in_flight, 200)),
        "kib_per_attempt": memory,
    }
    if args.json:
        print(json.dumps({**report, **more}))
        return
    print(machine_text(machine_facts(("rlightning_aio", "uvloop"))))
    for place, found in report.items():
        mine = found["play"]
        line = f"{place}: {mine['complete']} of {mine['groups']} groups complete"
        line += f", rewards {mine['rewards']}, {mine['left']} requests and tasks left"
        line += f", {mine['seconds']:.1f} s, event-loop lag {mine['lag_p99_ms']:.1f} ms (p99)"
        print(f"\n{line}")
        for kind, count in found["injected"].items():
            print(f"  {kind}: {count} injected, {mine['failures'].get(kind, 0)} found")
        print(f"  by gather: {found['gather']['end']}, {found['gather']['attempts']} attempts done")
    for rule, found in rules.items():
        line = f"{rule} of {SIZE}: {found['seconds_per_group']:.3f} s for each group"
        if found["freed_s"] is not None:
            line += f"; an env plays the next attempt {found['freed_s']:.3f} s later, at most"
        print(f"\n{line}")
    print("\ncancelled in a step that never ends, an env is free, and has begun an episode after:")
    for place, found in freed.items():
        print(f"  {place}: {found['free_s']:.2f} s, {found['begun_s']:.2f} s")
    for how, found in flights.items():
        line = f"{args.in_flight} in flight, {how}: "
        line += f"event-loop lag {found['lag_p99_ms']:.1f} ms (p99), "
        line += f"{found['lag_max_ms']:.1f} at most, {found['us_per_step']:.0f} µs for a step, "
        line += f"longest garbage collection {found['longest_collection_ms']:.1f} ms"
        print(f"\n{line}")
    print(f"\n{more['alone_us_per_step']:.0f} µs for a step whose result comes alone")
    print(f"\n{more['kib_per_attempt']:.1f} KiB for each of {IN_FLIGHT} attempts in flight")


if __name__ == "__main__":
    main()
