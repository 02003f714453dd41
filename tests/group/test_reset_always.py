"""`reset()` of all envs always works: what is in flight is awaited and dropped."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from kit.scripted import Counts

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio.errors import EnvBusy, NothingPending

ENTRY: dict[str, Any] = {"name": "a", "num_workers": 3}
PLACES: dict[str, dict[str, Any]] = {
    "workers": {"envs_per_process": 2},
    "inline": {"placement": "inline"},
}


class Failing(Counts):
    """Raises at an action of 9."""

    def does(self, action: Any) -> None:
        if action == 9:
            raise ValueError("nine")


@pytest.fixture(params=PLACES)
def entry(request: pytest.FixtureRequest) -> dict[str, Any]:
    return {**ENTRY, **PLACES[request.param], "task": Failing}


def test_results_and_errors_that_nobody_has_collected_are_dropped(entry: dict[str, Any]) -> None:
    """They don't come back, and the first observations are those of new episodes."""
    with rlightning_aio.sync.build_env_group(entry) as group:
        batch, _ = group.reset()
        for actions in ([1, 1, 1], [9, 1, 9], [9, 9, 9]):
            group.step_async(batch.respond(action=np.array(actions)))
            batch, flags = group.reset()
            assert batch.ids() == group.env_ids
            assert flags == [False] * 3
            assert batch.observation.tolist() == [[0]] * 3
            assert group.pending == []
            with pytest.raises(NothingPending):
                group.collect_async()
        batch, _ = group.step(batch.respond(action=np.ones(3, int)))
        assert batch.observation.tolist() == [[1]] * 3


async def test_what_a_cancelled_call_has_left_is_dropped(entry: dict[str, Any]) -> None:
    """Steps go on in their envs, and so do calls of methods; a reset waits for both."""
    async with rlightning_aio.build_env_group(entry) as group:
        batch, _ = await group.reset()
        calls = [
            asyncio.create_task(group["a-2"].call("wrapper_names")),
            asyncio.create_task(group.step(batch.take([0, 1]).respond(action=[1, 9]))),
        ]
        await asyncio.sleep(0)
        for call in calls:
            call.cancel()
        ended = await asyncio.gather(*calls, return_exceptions=True)
        assert [type(error) for error in ended] == [asyncio.CancelledError] * 2
        batch, _ = await group.reset()
        assert batch.observation.tolist() == [[0]] * 3
        assert group.pending == []


async def test_it_takes_nothing_from_a_call_that_waits(entry: dict[str, Any]) -> None:
    """That is refused, and nothing is sent or dropped."""
    async with rlightning_aio.build_env_group(entry) as group:
        batch, _ = await group.reset()
        group.step_async(batch.take([0]).respond(action=[1]))
        step = asyncio.create_task(group.step(batch.take([1]).respond(action=[1])))
        await asyncio.sleep(0)
        with pytest.raises(EnvBusy):
            await group.reset()
        assert (await step)[0].ids() == ["a-1"]
        collect = asyncio.create_task(group.collect_async())
        assert (await collect)[0].ids() == ["a-0"]
