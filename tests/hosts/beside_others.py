"""Checks that every kind of host passes in one group with others; callers choose the hosts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from group.sample_envs import Probe

from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio.errors import EnvRaised


def entry(name: str, backend: str, placement: str, **fields: Any) -> Any:
    fields = {"task": "-", "imports": ["group.sample_envs"], **fields}
    return {"name": name, "backend": backend, "placement": placement, **fields}


def steps(**actions: Any) -> BatchedData:
    ids = [name.replace("_", "-") for name in actions]
    responses = [PolicyResponse(i, a) for i, a in zip(ids, actions.values(), strict=True)]
    return BatchedData(ids, responses)


async def both_ways(number: int, group: Any, batch: Any, action: Any) -> tuple[Any, Any]:
    """Step by `step` for odd numbers, and by `step_async` and `collect_async` for even ones."""
    if number % 2:
        return await group.step(batch.respond(action=action))
    group.step_async(batch.respond(action=action))
    return await group.collect_async(wait_all=True)


def check_three_are_equal(batch: Any, flags: Any) -> None:
    """Check that a batch has equal thirds, from three places with equal envs and actions."""
    for values in (
        *(batch.observation, batch.reward, batch.terminated, batch.truncated),
        *(batch.is_reset, batch.limit_reached, np.array(flags)),
    ):
        first, *others = np.split(np.asarray(values), 3)
        for other in others:
            np.testing.assert_array_equal(other, first, strict=True)
    infos = [ret.info for ret in batch.values()]
    third = len(infos) // 3
    assert infos[:third] == infos[third : 2 * third] == infos[2 * third :]


async def check_usable_after_an_error(group: Any) -> None:
    """Check a group of ``one-0`` and ``one-1``, which share a host."""
    await group.reset()
    with pytest.raises(EnvRaised, match=r"env 'one-1'.* raised in step") as caught:
        await group.step(steps(one_0=[0.0, 5.0], one_1=[Probe.RAISE, 0.0]))
    assert caught.value.exception_type == "group.sample_envs.OddError"
    assert "sample_envs.py" in caught.value.traceback_text
    assert caught.value.results.reward.tolist() == [5]
    batch, _ = await group.step(steps(one_0=[0.0, 6.0], one_1=[0.0, 7.0]))
    assert batch.reward.tolist() == [6, 7]


async def check_methods(group: Any) -> None:
    """Check that calls of ``one-0`` return values, and that only the caller gets their errors."""
    handle = group["one-0"]
    assert await handle.call("double", [4], times=3) == [4, 4, 4]
    with pytest.raises(EnvRaised, match=r"raised in the call of double\(\): TypeError"):
        await handle.call("double", None)
    await handle.set_attr("label", "changed")
    assert await handle.get_attr("label") == "changed"
    await group.reset()
    assert (await handle.step([0.0, 2.0])).last_reward == 2
