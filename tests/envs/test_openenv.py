"""The `openenv` backend against a server that misbehaves."""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import asyncio
import math
from functools import wraps
from typing import Any

import numpy as np
import pytest
from envs.misbehaving_openenv import Misbehaving, numbers
from gymnasium import spaces
from patience import HANG

import rlightning_aio as rl
from rlightning_aio.errors import StartFailed
from rlightning_aio.loop_thread import LoopThread
from rlightning_aio.plugins.openenv.session import OpenEnvSession, ServerRefused

ENVS = 4


def on_asyncio(test: Any) -> Any:
    """Run a coroutine function on asyncio's loop only: uvloop keeps a descriptor of a server."""

    @wraps(test)
    def run() -> None:
        asyncio.run(test())

    return run


def steps_of(*env_ids: str) -> rl.BatchedData:
    """Return responses with unique actions."""
    steps = [rl.PolicyResponse(env_id, {"number": next(numbers)}) for env_id in env_ids]
    return rl.BatchedData(list(env_ids), steps)


async def until_free(server: Misbehaving) -> None:
    while server.sessions:  # noqa: ASYNC110  # It has still to see the sockets close.
        await asyncio.sleep(0.001)


def entry(url: str, **fields: Any) -> dict[str, Any]:
    fields = {"num_workers": ENVS, "placement": "loop", **fields}
    return {"name": "o", "backend": "openenv", "task": url, **fields}


@on_asyncio
async def test_a_lost_socket_ends_the_episode_as_truncated() -> None:
    """With the last observation, and the cause in the info; the next step begins a new episode."""
    async with (
        Misbehaving(capacity=1) as server,
        rl.build_env_group(entry(server.url, num_workers=1)) as group,
        group.auto_reset(math.inf),
    ):
        batch, _ = await group.reset()
        batch, _ = await group.step(batch.respond(action=[{"number": next(numbers)}]))
        before = batch.observation
        server.fates.append("lost after")
        batch, _ = await group.step(batch.respond(action=[{"number": next(numbers)}]))
        assert batch.truncated.all()
        assert batch.observation == before
        assert server.url in batch.info("session_lost")[0]
        batch, _ = await group.step(batch.respond(action=[{"number": 0}]))
        assert batch.is_reset.all()


def kept(server: Misbehaving, **fields: Any) -> dict[str, Any]:
    return entry(server.url, num_workers=1, env_kwargs={"session": "keep"}, **fields)


@pytest.mark.parametrize("fate", ["idle loss", "lost before", "lost after", "restart"])
def test_a_kept_session_repeats_no_action_that_may_have_run(fate: str) -> None:
    """The step after a lost socket continues if the server can say that the action has not run."""
    asyncio.run(_lose(fate))


async def _lose(fate: str) -> None:
    async with Misbehaving(capacity=1) as server:
        async with rl.build_env_group(kept(server)) as group:
            await group.reset()
            (session,) = server.sessions.values()
            await group.step(steps_of("o-0"))
            server.fates.append(fate)
            batch, _ = await group.step(steps_of("o-0"))
            if fate == "idle loss":
                batch, _ = await group.step(steps_of("o-0"))
            assert batch.truncated.all() == (fate in ("lost after", "restart"))
            assert set(server.executed.values()) == {1}
            assert len(server.executed) == 3 if fate == "idle loss" else 2
            await group.reset()
            assert (session in server.sessions.values()) == (fate != "restart")
        assert not server.sessions


@on_asyncio
async def test_an_action_goes_only_to_its_own_session() -> None:
    """The server has forgotten the session before the first step."""
    async with Misbehaving(capacity=1) as server, rl.build_env_group(kept(server)) as group:
        await group.reset()
        server.restart()
        batch, _ = await group.step(steps_of("o-0"))
        assert batch.truncated.all()
        assert not server.executed


@on_asyncio
async def test_a_session_that_comes_too_late_is_closed() -> None:
    """Its env was closed while the server was creating it."""
    async with Misbehaving(capacity=1) as server:
        server.may_create.clear()
        group = rl.build_env_group(kept(server))
        await group.init()
        resetting = asyncio.create_task(group.reset())
        await server.creating.wait()
        resetting.cancel()
        closing = asyncio.create_task(group.close())
        await asyncio.wait({resetting})
        server.may_create.set()
        await closing
        await until_free(server)
        assert server.most == 1


@on_asyncio
async def test_a_session_is_closed_even_if_nobody_waits_for_it() -> None:
    async with Misbehaving(capacity=1) as server:
        session = OpenEnvSession(server.url, keep=True)
        await session.open({"type": "state"})
        closing = asyncio.create_task(session.close())
        await asyncio.sleep(0)
        closing.cancel()
        await until_free(server)


@on_asyncio
async def test_sessions_are_closed_even_if_another_server_is_dead() -> None:
    async with Misbehaving(capacity=1) as lasting:
        async with Misbehaving(capacity=1) as dying:
            config = kept(dying)
            config["env_kwargs"] |= {"urls": [lasting.url]}
            group = rl.build_env_group(config)
            await group.init()
            await group.reset()
        await group.reset()
        assert len(lasting.sessions) == 1
        with pytest.warns(UserWarning, match="can't be reached"):
            await group.close()
        assert not lasting.sessions


@on_asyncio
async def test_a_refusal_is_read_even_if_the_socket_is_closed() -> None:
    async with Misbehaving(capacity=0) as server:
        session = OpenEnvSession(server.url, keep=False)
        await session._connect(may_create=True)
        assert session._socket is not None
        await session._socket._socket.wait_closed()
        with pytest.raises(ServerRefused, match="CAPACITY_REACHED"):
            await session.ask({"type": "state"})


@on_asyncio
async def test_an_env_queues_while_its_server_is_full() -> None:
    async with Misbehaving(capacity=1) as server:
        first = rl.build_env_group(entry(server.url, num_workers=1))
        second = rl.build_env_group(entry(server.url, num_workers=1))
        async with second:
            async with first:
                await first.reset()
                resetting = asyncio.create_task(second.reset())
                await server.refused.wait()
                assert not resetting.done()
            await resetting
        assert server.most == 1


@on_asyncio
async def test_sessions_outlive_a_learner_that_holds_the_event_loop() -> None:
    """They are in one worker by default, which answers the pings of their servers meanwhile."""

    async def ping_all() -> int:
        for socket in [*server._sockets]:
            await socket.ping()
        return len(server._sockets)

    thread, server = LoopThread("server"), Misbehaving(capacity=ENVS)
    thread.submit(server.__aenter__()).result()
    try:
        config = {"name": "o", "backend": "openenv", "task": server.url, "num_workers": ENVS}
        async with rl.build_env_group(config) as group:
            await group.reset()
            assert len(group.get_workers()) == 1
            # It waits for the answers without its event loop, as a learner computes.
            assert thread.submit(ping_all()).result(HANG) == ENVS
            batch, _ = await group.step(steps_of(*group.env_ids))
            assert not batch.truncated.any()
    finally:
        thread.submit(server.__aexit__()).result()
        thread.close()


@on_asyncio
async def test_envs_of_a_dead_server_move_to_another() -> None:
    async with Misbehaving(capacity=ENVS) as lasting:
        async with Misbehaving(capacity=ENVS) as dying:
            config = entry(dying.url, env_kwargs={"urls": [lasting.url]})
            group = rl.build_env_group(config)
            await group.init()
            await group.reset()
            assert len(dying.sessions) == len(lasting.sessions) == 2
        with group.auto_reset(math.inf):
            batch, _ = await group.step(steps_of(*group.env_ids))
            for _ in range(2):
                batch, _ = await group.step(steps_of(*group.env_ids))
        assert not batch.truncated.any()
        assert len(lasting.sessions) == ENVS
        await group.close()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"columns": {"a": {"shap": [3]}}}, "columns.a"),
        ({"columns": {"a": 5}, "observation_field": "b"}, "exclude each other"),
        ({"url": "x"}, "Known fields: urls"),
        ({"session": "kept"}, "session"),
    ],
    ids=str,
)
async def test_wrong_options_are_named(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises((StartFailed, ValueError), match=message):
        await rl.build_env_group(entry("http://127.0.0.1:1", env_kwargs=kwargs)).init()


async def test_fields_become_columns_of_their_spaces() -> None:
    config = entry("http://127.0.0.1:1", env_kwargs={"columns": {"a": 5, "b": {"shape": [2, 2]}}})
    async with rl.build_env_group(config) as group:
        space = group.get_observation_spaces()[0]
    assert isinstance(space, spaces.Dict)
    assert space["a"] == spaces.Discrete(5)
    assert space["b"] == spaces.Box(-np.inf, np.inf, (2, 2), np.float32)
