"""What tests of hosts need that share a group with others; callers choose the hosts."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlightning_aio import BatchedData, PolicyResponse


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
