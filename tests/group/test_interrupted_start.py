"""A start that is interrupted leaves nothing running and raises only its cause."""

from __future__ import annotations

import asyncio

import pytest

import rlightning_aio
from rlightning_aio.errors import GroupClosed, RLightningError, StartFailed

ENTRY = {"name": "cartpole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}


@pytest.mark.parametrize("times", [1, 2])
async def test_cancelling_init_closes_the_group_and_raises_the_cancellation(times: int) -> None:
    """Everything that was started is closed; a second cancellation doesn't wait for the workers."""
    group = rlightning_aio.build_env_group(ENTRY)
    starting = asyncio.ensure_future(group.init())
    for _ in range(times):
        await asyncio.sleep(0)  # `init` has sent its first request and waits.
        starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    with pytest.raises(GroupClosed):
        await group.init()


@pytest.mark.parametrize("placement", ["process", "inline"])
async def test_a_group_that_starts_may_be_closed_and_is_started_once(placement: str) -> None:
    for other, error in (("close", GroupClosed), ("init", RLightningError)):
        group = rlightning_aio.build_env_group({**ENTRY, "placement": placement})
        calls = group.init(), getattr(group, other)()
        found = await asyncio.gather(*calls, return_exceptions=True)
        assert error in map(type, found)
        await group.close()


async def test_a_start_that_fails_keeps_no_memory() -> None:
    """A group whose envs can't be built is freed with its last reference, closed or not."""
    group = rlightning_aio.build_env_group({**ENTRY, "task": "NoSuchTask-v0"})
    with pytest.raises(StartFailed):
        await group.init()
