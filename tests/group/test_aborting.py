"""Requests that end without a result, where random programs ask for none."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import pytest
from group.sample_envs import Probe
from kit.scripted import Counts

from rlightning_aio import BatchedData, PolicyResponse, UnknownEnv, build_env_group, sync
from rlightning_aio.errors import EnvRaised, EpisodeLost, GroupClosed

ENTRY = {"name": "probe", "backend": "probe", "task": "-", "num_workers": 4}
IDS = [f"probe-{k}" for k in range(4)]


def steps(*env_ids: str, what: int = Probe.DO_NOTHING) -> BatchedData:
    responses = [PolicyResponse(env_id, np.array([what, 5.0])) for env_id in env_ids]
    return BatchedData(list(env_ids), responses)


async def test_a_call_can_be_aborted() -> None:
    """Its env is free, and the call says so."""
    async with build_env_group(ENTRY) as group:
        await group.reset(seed=3)
        call = asyncio.create_task(group.call("get_attr", "label", env_ids=IDS[:2]))
        await asyncio.sleep(0)
        await group.abort(IDS[:1])
        (outcome,) = await asyncio.gather(call, return_exceptions=True)
        if isinstance(outcome, EpisodeLost):
            assert outcome.env_id == IDS[0]
        else:
            assert outcome == ["outer"] * 2  # It had ended before.
        batch, _ = await group.step(steps(IDS[0]))
        assert batch.restarted.tolist() == [isinstance(outcome, EpisodeLost)]
        await group.step(steps(*IDS))


@pytest.mark.one_driver_for_each_place
async def test_a_drain_raises_errors_once_all_envs_are_idle(start: Any) -> None:
    """The results are in the error, as those of a step are."""
    group = await start(ENTRY)
    await group.reset(seed=3)
    group.step_async(steps(IDS[2], IDS[0], what=Probe.RAISE))
    group.step_async(steps(IDS[1], IDS[3]))
    with pytest.raises(EnvRaised) as raised:
        await group.drain(deadline=200.0)
    assert raised.value.results.ids() == [IDS[1], IDS[3]]
    faulty = {raised.value.env_id, *(other.env_id for other in raised.value.others)}
    assert faulty == {IDS[0], IDS[2]}
    assert group.pending == []
    batch, flags = await group.drain()
    empty = batch.observation, batch.done, batch.outcome, batch.sent.action, batch.take([]).done
    assert (flags, list(map(len, empty))) == ([], [0] * 5)


@pytest.mark.one_driver_for_each_place
async def test_wrong_arguments_end_nothing(start: Any) -> None:
    """A drain may have any time, more than the system can count as well."""
    group = await start(ENTRY)
    await group.reset(seed=3)
    group.step_async(steps(*IDS))
    with pytest.raises(UnknownEnv, match="'nobody'"):
        await group.abort([IDS[0], "nobody"])
    with pytest.raises(ValueError, match="deadline must be a positive number"):
        await group.drain(deadline=0)
    for deadline in (1e12, math.inf):
        assert (await group.drain(deadline))[0].ids() == IDS
        group.step_async(steps(*IDS))
    await group.close()
    for ending in (group.abort, group.drain):
        with pytest.raises(GroupClosed):
            await ending()


def test_the_seed_of_an_aborted_reset_is_nobody_elses() -> None:
    """The reset after it brings options, and so travels beside the row that has the seed."""

    class Told(Counts):
        length = 1

        def told(self) -> dict[str, Any]:
            return {"seed": -1 if self.seed is None else self.seed}

    with sync.build_env_group(task=Told, placement="inline") as group:
        group.reset_async(seed=5)
        group.abort()
        batch, _ = group.reset(options={"deed": 0})
        with group.auto_reset(math.inf):
            for _ in range(2):
                batch, _ = group.step(batch.respond(action=[0]))
        assert batch.is_reset.tolist() == [True]
        assert [info["seed"] for info in batch.info()] == [-1]
