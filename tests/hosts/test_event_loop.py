"""What `event_loop` keeps of requests."""

from __future__ import annotations

import asyncio
import weakref

from patience import HANG

from rlightning_aio._core.hosts.awaiting.event_loop import TimeLimit


class Env:
    entry = 1


async def test_a_time_limit_keeps_nothing_of_requests_that_have_ended() -> None:
    """However many end before the first of them would have been late."""
    limit = TimeLimit(HANG, lambda env, seconds: None)
    loop = asyncio.get_running_loop()
    envs = [Env() for _ in range(100)]
    ended = [weakref.ref(env) for env in envs]
    while envs:
        limit.begin(envs[-1], loop)
        envs.pop().entry = 0
    limit.begin(Env(), loop)
    assert [one() for one in ended] == [None] * 100
    limit.end()
