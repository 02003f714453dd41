"""Inline simulators that release the GIL compute their steps in threads."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from patience import HANG
from vector.toys import assert_alike

import rlightning_aio.sync
from rlightning_aio import build_env_group
from rlightning_aio.envs.background import Background
from rlightning_aio.errors import EnvRaised


class Gated(SyncVectorEnv):
    """Two CartPoles whose steps wait for a gate; an action of all left raises."""

    releases_gil = True

    def __init__(self) -> None:
        super().__init__([lambda: gym.make("CartPole-v1")] * 2)
        self.gate, self.began = threading.Event(), threading.Event()
        self.threads: list[int] = []

    def step(self, actions: Any) -> Any:
        self.threads.append(threading.get_ident())
        self.began.set()
        assert self.gate.wait(HANG), "the thread that opens the gate is blocked"
        if not actions.any():
            raise ValueError("both to the left")
        return super().step(actions)


def entry(*gated: Gated) -> Any:
    makers = [lambda env=env: env for env in gated]
    return {"name": "gated", "placement": "inline", "num_workers": len(gated), "task": makers}


RIGHT = np.ones((1, 2), np.int64)


async def test_a_step_that_a_thread_computes_does_not_block_the_loop() -> None:
    """Results are handed out first come, first served, and errors as always."""
    slow, fast = Gated(), Gated()
    async with build_env_group(entry(slow, fast)) as group:
        first, _ = await group.reset(seed=0)
        fast.gate.set()
        group.step_async(first.respond(action=np.repeat(RIGHT, 2, axis=0)))
        batch, _ = await group.collect_async()
        assert batch.ids() == ["gated-1"]
        waiting = asyncio.create_task(group.collect_async())
        await asyncio.to_thread(slow.began.wait, HANG)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.shield(waiting), 0.001)
        slow.gate.set()
        batch, _ = await waiting
        assert batch.ids() == ["gated-0"]
        group.step_async(batch.respond(action=np.zeros((1, 2), np.int64)))
        with pytest.raises(EnvRaised, match="both to the left"):
            await group.collect_async()
        batch, _ = await group.step(batch.respond(action=RIGHT))
        assert batch.reward.tolist() == [[1.0, 1.0]]
        assert threading.get_ident() not in slow.threads + fast.threads


async def test_a_group_is_closed_while_a_thread_computes() -> None:
    """The step ends first; its result is dropped."""
    gated = Gated()
    async with build_env_group(entry(gated)) as group:
        batch, _ = await group.reset(seed=0)
        group.step_async(batch.respond(action=RIGHT))
        await asyncio.to_thread(gated.began.wait, HANG)
        gated.gate.set()


def test_in_a_synchronous_group_a_step_starts_when_it_is_sent() -> None:
    """A thread computes while the trainer does something else."""
    gated = Gated()
    with rlightning_aio.sync.build_env_group(entry(gated)) as group:
        batch, _ = group.reset(seed=0)
        group.step_async(batch.respond(action=RIGHT))
        assert gated.began.wait(HANG)
        gated.gate.set()
        batch, _ = group.collect_async()
        assert batch.reward.tolist() == [[1.0, 1.0]]
        assert threading.get_ident() not in gated.threads


def test_the_waiting_thread_computes_a_step_that_has_not_begun() -> None:
    """It waits for a step that has begun."""
    release, begun = threading.Event(), threading.Event()

    def work(argument: int) -> tuple[int, int]:
        if argument == 1:
            begun.set()
            assert release.wait(HANG)
        return argument, threading.get_ident()

    background = Background(work)
    background.start(1)
    assert begun.wait(HANG)
    release.set()
    argument, thread = background.wait()
    assert (argument, thread == threading.get_ident()) == (1, False)
    background.start(2)
    assert background.wait()[0] == 2
    background.close()


async def test_halves_of_a_mujoco_batch_are_collected_in_turn() -> None:
    """One half computes while the other is collected; the results are equal bit for bit."""
    task = "InvertedPendulum-v5"
    fields = {"num_workers": 2, "num_envs": 2, "placement": "inline", "max_episode_steps": 7}
    plain = SyncVectorEnv([lambda: gym.make(task, max_episode_steps=7)] * 4)
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 2, 2, 1)).astype(np.float32)
    observation, _ = plain.reset(seed=3)
    expected: dict[tuple[int, int], Any] = {(k, -1): observation[2 * k : 2 * k + 2] for k in (0, 1)}
    for turn, action in enumerate(actions):
        results = plain.step(action.reshape(4, 1))
        for k in range(2):
            expected[k, turn] = [column[2 * k : 2 * k + 2] for column in results[:4]]
    plain.close()
    entry = {"name": "half", "backend": "mujoco", "task": task, **fields}
    async with build_env_group(entry) as group:
        batch, _ = await group.reset(seed=3)
        assert_alike(batch.observation, np.stack([expected[k, -1] for k in range(2)]))
        turns = dict.fromkeys(group.env_ids, 0)
        group.step_async(batch.respond(action=actions[0]))
        for _ in range(50):
            batch, _ = await group.collect_async(min_results=1, max_results=1)
            (env_id,) = batch.ids()
            k = group.env_ids.index(env_id)
            columns = batch.observation, batch.reward, batch.terminated, batch.truncated
            assert_alike([column[0] for column in columns], expected[k, turns[env_id]])
            turns[env_id] += 1
            if turns[env_id] < len(actions):
                group.step_async(batch.respond(action=actions[turns[env_id]][k : k + 1]))
    assert min(turns.values()) > 10
