"""Requests that end without a result, in every placement and with every driver."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from group.sample_envs import Gate
from kit.scripted import Counts

from rlightning_aio import (
    BatchedData,
    NothingPending,
    PolicyResponse,
    UnknownEnv,
    build_env_group,
    sync,
)
from rlightning_aio.errors import EnvRaised, EpisodeLost, GroupClosed

if TYPE_CHECKING:
    from pathlib import Path

IDS = [f"gated-{k}" for k in range(4)]
DO_NOTHING, END, TRUNCATE, RAISE = range(4)


def steps(*env_ids: str, what: int = DO_NOTHING) -> BatchedData:
    return BatchedData(
        list(env_ids), [PolicyResponse(env_id, np.array([what, 5.0])) for env_id in env_ids]
    )


@pytest.fixture
def entry(tmp_path: Path) -> dict[str, Any]:
    """Four envs; those without a gate wait for ever in a step."""
    return {
        "name": "gated",
        "backend": "gated_where_there_is_one",
        "task": "-",
        "num_workers": 4,
        "env_kwargs": {"gates": str(tmp_path)},
    }


async def test_an_aborted_env_is_free_and_begins_an_episode(
    start: Any, entry: dict[str, Any], tmp_path: Path
) -> None:
    """Its step hangs; a step is then a reset in disguise, as after a restart."""
    group = await start(entry)
    await group.reset(seed=3)
    Gate(str(tmp_path), IDS[1]).make()
    group.step_async(steps(IDS[1]))
    await group.abort([IDS[1]])
    assert group.pending == []
    with pytest.raises(NothingPending):
        await group.collect_async()
    (tmp_path / IDS[1]).unlink()
    batch, _ = await group.step(steps(IDS[1]))
    assert batch.is_reset.tolist() == batch.restarted.tolist() == [True]
    assert batch.info("worker_restarted")[0]
    batch, _ = await group.step(steps(*IDS))
    assert batch.observation[1, 2] == 1


async def test_results_that_were_not_collected_are_dropped(start: Any, entry: Any) -> None:
    """Of the envs that are named; those of others stay."""
    group = await start(entry)
    await group.reset(seed=3)
    group.step_async(steps(*IDS))
    batch, _ = await group.collect_async(max_results=1)
    (first,) = batch.ids()
    dropped, *others = (env_id for env_id in IDS if env_id != first)
    await group.abort([dropped])
    assert sorted(group.pending) == others
    batch, _ = await group.collect_async(wait_all=True)
    assert sorted(batch.ids()) == others
    assert not batch.restarted.any()
    batch, _ = await group.step(steps(*IDS))
    assert batch.restarted.tolist() == [env_id == dropped for env_id in IDS]


async def test_a_call_can_be_aborted(entry: dict[str, Any]) -> None:
    """Its env is free, and the call says so."""
    async with build_env_group(entry) as group:
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
async def test_a_drain_returns_what_is_in_flight(start: Any, entry: Any) -> None:
    """In the order of the group; all envs are idle then."""
    group = await start(entry)
    await group.reset(seed=3)
    assert len((await group.drain())[0]) == 0
    for deadline in (None, 200.0, 1e12, math.inf):
        group.step_async(steps(*reversed(IDS)))
        batch, flags = await group.drain(deadline)
        assert (batch.ids(), flags, group.pending) == (IDS, [False] * 4, [])


@pytest.mark.one_driver_for_each_place
async def test_a_drain_raises_errors_once_all_envs_are_idle(start: Any, entry: Any) -> None:
    """The results are in the error, as those of a step are."""
    group = await start(entry)
    await group.reset(seed=3)
    group.step_async(steps(IDS[2], IDS[0], what=RAISE))
    group.step_async(steps(IDS[1], IDS[3]))
    with pytest.raises(EnvRaised) as raised:
        await group.drain(deadline=200.0)
    assert raised.value.results.ids() == [IDS[1], IDS[3]]
    assert {raised.value.env_id, *(other.env_id for other in raised.value.others)} == {
        IDS[0],
        IDS[2],
    }
    assert group.pending == []
    assert len((await group.drain())[0]) == 0


@pytest.mark.one_driver_for_each_place
async def test_wrong_arguments_end_nothing(start: Any, entry: Any) -> None:
    group = await start(entry)
    await group.reset(seed=3)
    group.step_async(steps(*IDS))
    with pytest.raises(UnknownEnv, match="'nobody'"):
        await group.abort([IDS[0], "nobody"])
    with pytest.raises(ValueError, match="deadline must be a positive number"):
        await group.drain(deadline=0)
    assert len((await group.collect_async(wait_all=True))[0]) == 4
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
