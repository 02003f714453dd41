"""A `World` runs real groups over simulated processes, and is the same for the same seed."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from kit.counting import CountingEnv as CountedSteps
from kit.scripted import Awaitable, Counts
from simulator.world import Deadlock, Faults, World

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.errors import EnvRaised, StartFailed, WorkerDied


class CountingEnv(Counts):
    """Its observation is its seed and the number of its steps; an action raises if it is 1."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    nested = False

    def does(self, action: Any) -> None:
        if action == 1:
            raise ValueError("as asked for")
        self.nested = bool(action == 2)

    def observed(self) -> Any:
        return np.array([-1 if self.seed is None else self.seed, self.steps], np.float64)

    def told(self) -> dict[str, Any]:
        return {"nested": [self.steps]} if self.steps and self.nested else {}

    def count(self) -> int:
        return self.steps


class AwaitableEnv(Awaitable):
    """The same, whose coroutines take a while."""

    def __init__(self) -> None:
        super().__init__(CountingEnv)

    async def pause(self, action: Any = None) -> None:
        await asyncio.sleep(0.01 if action is None else 0.01 * action)


def config(**fields: Any) -> rl.EnvConfig:
    return rl.EnvConfig(
        name="counting",
        backend="callable",
        **{"task": CountingEnv, "num_workers": 4, "envs_per_process": 2, **fields},
    )


def played(world: World, **fields: Any) -> list[float]:
    """Play with a synchronous group; return all numbers that were seen."""
    seen: list[float] = []
    with world, sync.build_env_group(config(**fields)) as group:
        batch, _ = group.reset(seed=5)
        for _ in range(5):
            batch, _ = group.step(batch.respond(action=np.zeros(4, np.int64)))
            seen += batch.observation.ravel().tolist()
        group.step_async(batch.respond(action=np.full(4, 2)))
        left = 4
        while left:
            batch, _ = group.collect_async(min_results=1)
            left -= len(batch)
            seen += batch.observation.ravel().tolist()
        saved = group.snapshot()
        assert group["counting-1"].call("count") == 6
        batch, _ = group.restore(saved)
        with pytest.raises(EnvRaised, match="as asked for"):
            group.step(batch.respond(action=np.array([0, 0, 1, 0])))
    return seen


async def played_async() -> list[float]:
    """Play with envs in workers, and with awaitable ones in a worker and on the loop."""
    seen: list[float] = []
    two = {"backend": "callable", "task": AwaitableEnv, "num_workers": 2}
    kinds = [
        config(),
        rl.EnvConfig(name="in-worker", envs_per_process=2, step_timeout=9.0, **two),
        rl.EnvConfig(name="on-loop", placement="loop", **two),
    ]
    async with rl.build_env_group(kinds) as group:
        batch, _ = await group.reset(seed=5)
        for k in range(99):  # Some of the workers are slow.
            group.step_async(batch.respond(action=np.full(len(batch), 2 * (k % 3))))
            batch, _ = await group.collect_async(min_results=2)
            seen += batch.observation.ravel().tolist()
        if group.pending:
            await group.collect_async(wait_all=True)
        assert await group["in-worker-1"].call("count") > 0
    return seen


@pytest.mark.parametrize("implementation", ["python", "c"])
def test_group_runs_over_simulated_processes(implementation: str) -> None:
    for seed in range(5):
        world = World(seed, implementation=implementation)
        seen = played(world)
        assert seen[:8] == [5, 1, 6, 1, 7, 1, 8, 1]
        assert world.counts["exits"] == 2
        assert world.counts["deaths"] == 0


def test_asynchronous_group_runs_on_the_loop_of_the_world() -> None:
    def trace(seed: int) -> list[str]:
        with World(seed) as world:
            assert set(world.run(played_async())[::2]) == set(range(5, 13))
        return world.trace

    for seed in range(5):
        assert trace(seed) == trace(seed)


class RemoteEnv(CountedSteps):
    """An env of a client that serves until the program ends."""

    def on_disconnect(self) -> None: ...


STORM = Faults(deaths=0.03, stops=0.02, interrupts=0.02, lags=0.02, starts=0.1, fork_servers=0.02)


def survived(seed: int) -> World:
    """Step through faults; the group must be usable, and close, when they are over."""
    world = World(seed, STORM)
    with world, suppress(StartFailed, KeyboardInterrupt):
        world.calm()
        with sync.build_env_group(
            config(step_timeout=5.0, reset_timeout=5.0, max_restarts=99)
        ) as group:
            batch, _ = group.reset(seed=5)
            world.storm()
            for _ in range(20):
                with suppress(KeyboardInterrupt, WorkerDied):
                    group.step(batch.respond(action=np.zeros(4, np.int64)))
                while group.pending:
                    with suppress(KeyboardInterrupt, WorkerDied):
                        group.collect_async()
            world.calm()
            while group.pending:
                group.collect_async()
            group.reset()  # Reports deaths from before.
            batch, _ = group.reset(seed=9)
            assert batch.observation.tolist() == [[9, 0], [10, 0], [11, 0], [12, 0]]
    return world


def test_group_survives_every_kind_of_fault() -> None:
    counts = sum((survived(seed).counts for seed in range(20)), Counter[str]())
    assert counts.keys() >= {"deaths", "stops", "interrupts", "lags", "slow starts", "refusals"}


def test_same_seed_gives_the_same_trace() -> None:
    for seed in range(5):
        assert survived(seed).trace == survived(seed).trace


def test_actors_of_ray_and_their_deaths_are_simulated() -> None:
    def world(seed: int, **faults: float) -> World:
        world = World(seed, Faults(**faults))
        given_up = suppress(StartFailed, WorkerDied)
        with world, given_up, sync.build_env_group(config(placement="ray")) as group:
            batch, _ = group.reset(seed=5)
            for _ in range(10):
                batch, _ = group.step(batch.respond(action=np.zeros(4, np.int64)))
            world.calm()
            group.reset()
            if not faults:
                assert batch.observation.tolist() == [[5, 10], [6, 10], [7, 10], [8, 10]]
        return world

    world(1)
    for seed in range(5):
        faulty = world(seed, deaths=0.05)
        assert faulty.trace == world(seed, deaths=0.05).trace
        assert faulty.counts["deaths"]


class TimedEnv(CountingEnv):
    """A step takes as many seconds as its action says."""

    def does(self, action: Any) -> None:
        time.sleep(int(action))


@pytest.mark.parametrize(
    ("seconds", "end"), [([9] * 4, None), ([0, 99, 0, 0], "hung in a step and was killed")]
)
def test_an_actor_has_the_time_limits_of_all_its_steps(seconds: list[int], end: Any) -> None:
    """It executes them in turn, and doesn't tell which of them takes so long."""
    one = {"placement": "ray", "envs_per_process": 4, "step_timeout": 10.0}
    with World(1, Faults()), sync.build_env_group(config(task=TimedEnv, **one)) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=seconds))
        assert [info.get("worker_restarted") for info in batch.info()] == [end] * 4


def test_clients_of_an_env_server_are_simulated() -> None:
    def world(seed: int) -> World:
        world = World(seed, Faults(cuts=0.05))
        kwargs = {"heartbeat": 1.0, "clients": ["c0", "c1"], "connect_timeout": 900.0}
        entry = {"name": "robots", "backend": "env_server", "env_kwargs": kwargs}
        with world, sync.build_env_group(entry) as group:
            for k in range(2):
                world.network.client(partial(RemoteEnv, k), group["robots-0"].address, f"c{k}")
            for _ in range(9):
                batch, _ = group.reset(seed=5)
                assert batch.observation[:, 0].tolist() == [0, 1]
                group.step_async(batch.respond(action=np.zeros((2, 2), np.float32)))
                batch, _ = group.collect_async(wait_all=True)
                for ret, is_new in zip(batch.values(), batch.is_reset, strict=True):
                    assert ret.observation[2] == 1 or is_new
        return world

    worlds = [world(seed) for seed in range(5)]
    assert [one.trace for one in worlds] == [world(seed).trace for seed in range(5)]
    assert any(one.counts["cuts"] for one in worlds)


def test_a_program_that_goes_on_without_end_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing happens in its world: its event loop turns."""
    monkeypatch.setattr("simulator.world._MAX_EVENTS", 1000)

    def turn() -> None:
        asyncio.get_running_loop().call_soon(turn)

    async def main() -> None:
        turn()
        await asyncio.Event().wait()

    with World(1) as world, pytest.raises(Deadlock):
        world.run(main())
