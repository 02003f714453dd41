"""Inline envs take turns, also with other tasks, and a step that raises counts for nothing."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from group.sample_envs import Probe
from kit.driven import INLINE

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio.errors import EnvRaised

PROBE = {"name": "one", "backend": "probe", "task": "-", "placement": "inline"}


def test_inline_entries_take_turns() -> None:
    """First come, first served: an env that gets a new request at once waits behind the others."""
    group = rlightning_aio.sync.build_env_group(
        [
            {
                "name": name,
                "backend": "gymnasium",
                "task": "CartPole-v1",
                "placement": "inline",
                "num_workers": 2,
                "max_episode_steps": 50,
            }
            for name in ("first", "second", "third")
        ]
    )
    came: Counter[str] = Counter()
    with group:
        batch, _ = group.reset(seed=0)
        with group.auto_reset():
            group.step_async(batch.respond(action=np.zeros(6, np.int64)))
            for _ in range(60):
                batch, _ = group.collect_async()
                came.update(list(batch.by_entry()))
                group.step_async(batch.respond(action=np.zeros(len(batch), np.int64)))
    assert came == {"first": 20, "second": 20, "third": 20}


async def test_a_cancelled_call_that_still_waits_for_its_turn_delays_no_request() -> None:
    """It is executed before the next request to its env, after those that were sent earlier."""
    entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}
    async with rlightning_aio.build_env_group({**entry, "placement": "inline"}) as group:
        batch, _ = await group.reset(seed=0)
        group.step_async(batch.take([1]).respond(action=[0]))
        call = asyncio.create_task(group["pole-0"].set_attr("gravity", 1.0))
        while "pole-0" not in group.pending:  # noqa: ASYNC110
            await asyncio.sleep(0)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        ret = await group["pole-0"].step(0)
        assert ret.last_reward == 1.0
        assert await group["pole-0"].get_attr("gravity") == 1.0
        batch, _ = await group.collect_async()
        assert batch.ids() == ["pole-1"]


@pytest.mark.timeout(60)
async def test_a_call_delays_no_ordinary_step_on_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is executed in its turn, though a trainer that has no core to spare never looks around."""
    monkeypatch.setattr("rlightning_aio._core.group.setup.build.num_cores", lambda: 1)
    entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}
    async with INLINE.build(entry) as group:
        for _ in range(12):  # As many batches as are compared with their spaces, and more.
            batch, _ = await group.reset(seed=0)
        core: Any = getattr(group, "wrapped", group)._core
        assert not core.tables.conditions.unusual
        core.supervisor.look_by = math.inf
        value = asyncio.create_task(group["pole-0"].get_attr("gravity"))
        await asyncio.sleep(0)
        group.step_async(batch.take([1]).respond(action=[0]))
        batch, _ = await group.collect_async()
        assert batch.ids() == ["pole-1"]
        assert await value == 9.8


async def test_other_tasks_have_their_turns() -> None:
    """A loop over an env that never waits lets other tasks run."""
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    async with rlightning_aio.build_env_group(PROBE) as group:
        batch, _ = await group.reset()
        task = asyncio.create_task(count())
        for _ in range(50):
            batch, _ = await group.step(batch.respond(action=np.zeros((1, 2))))
        task.cancel()
    assert turns >= 50


def test_a_step_that_raises_counts_towards_no_limit() -> None:
    """The limit counts completed steps."""
    with rlightning_aio.sync.build_env_group(PROBE) as group:
        batch, _ = group.reset()
        with group.auto_reset(max_episode_steps=3):
            with pytest.raises(EnvRaised):
                group.step(batch.respond(action=np.array([[Probe.RAISE, 0]])))
            for expected in (False, False, True):
                batch, flags = group.step(batch.respond(action=np.zeros((1, 2))))
                assert flags == [expected]
