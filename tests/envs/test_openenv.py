"""The `openenv` backend against a server that misbehaves."""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import asyncio
import json
import logging
import math
import threading
from contextlib import asynccontextmanager
from functools import wraps
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from cli.command import invoke, start, write_config
from envs.misbehaving_openenv import ERRORS, Misbehaving, numbers
from gymnasium import spaces
from patience import HANG

import rlightning_aio as rl
from rlightning_aio.errors import StartFailed
from rlightning_aio.plugins.openenv.session import OpenEnvSession, ServerGone

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

ENVS = 4


def on_asyncio(test: Any) -> Any:
    """Run a coroutine function on asyncio's loop only: uvloop keeps a descriptor of a server."""

    @wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        asyncio.run(test(*args, **kwargs))

    return run


def steps_of(*env_ids: str) -> rl.BatchedData:
    """Return responses with unique actions."""
    steps = [rl.PolicyResponse(env_id, {"number": next(numbers)}) for env_id in env_ids]
    return rl.BatchedData(list(env_ids), steps)


def entry(url: str, **fields: Any) -> dict[str, Any]:
    fields = {"num_workers": ENVS, "placement": "loop", **fields}
    return {"name": "o", "backend": "openenv", "task": url, **fields}


@asynccontextmanager
async def one_env(capacity: int = 1, **fields: Any) -> AsyncGenerator[tuple[Misbehaving, Any]]:
    """Yield a server and a group of one env, which was reset."""
    async with (
        Misbehaving(capacity) as server,
        rl.build_env_group(entry(server.url, num_workers=1, **fields)) as group,
    ):
        await group.reset()
        yield server, group


FATES = ("idle loss", "lost before", "lost after", "restart", "half a frame", "no JSON")


@pytest.mark.parametrize("fate", [*FATES, "another type"])
@on_asyncio
async def test_a_lost_socket_is_a_lost_env(fate: str) -> None:
    """The step is answered by the first result of a new episode; its action is not sent again."""
    async with one_env() as (server, group):
        await group.step(steps_of("o-0"))
        server.fates.append(fate)
        batch, _ = await group.step(steps_of("o-0"))
        if fate == "idle loss":
            assert not batch.restarted.any()
            while server.sockets:  # noqa: ASYNC110  # The client has still to see it close.
                await asyncio.sleep(0.001)
            batch, _ = await group.step(steps_of("o-0"))
        assert (batch.is_reset & batch.restarted & batch.truncated).all()
        assert batch.reward.tolist() == [0.0]
        assert batch.observation[0]["count"] == 0
        (outcome,) = batch.outcome
        assert (outcome.kind, outcome.blame) == ("env_away", "infrastructure")
        assert server.url in outcome.cause
        assert set(server.executed.values()) == {1}
        batch, _ = await group.step(steps_of("o-0"))
        assert batch.observation[0]["count"] == 1
        assert not batch.truncated.any()


@on_asyncio
async def test_a_reply_that_nobody_waits_for_answers_no_other_request() -> None:
    """Replies have no numbers, so an aborted step ends its session."""
    async with one_env(capacity=2) as (server, group):
        server.fates.append("never")
        group.step_async(steps_of("o-0"))
        await server.asked.wait()
        await group.abort()
        assert (await group.reset())[0].observation[0]["answers"] is None
        steps = steps_of("o-0")
        batch, _ = await group.step(steps)
        assert batch.observation[0]["answers"] == steps.values()[0].action["number"]
        assert set(server.executed.values()) == {1}


@pytest.mark.parametrize("fate", ["never", "no JSON", "another type"])
@on_asyncio
async def test_a_session_is_over_once_nobody_waits_for_a_reply(fate: str) -> None:
    """Whatever its env does: the next frame would be taken for the reply to another request."""
    async with Misbehaving(capacity=1) as server:
        session = OpenEnvSession(server.url)
        await session.open({"type": "reset", "data": {"episode_id": None}})
        server.fates.append(fate)
        step = {"type": "step", "data": {"number": next(numbers)}}
        asking = asyncio.create_task(session.ask(step))
        if fate == "never":
            await server.asked.wait()
            asking.cancel()
        await asyncio.wait({asking})
        assert asking.cancelled() or isinstance(asking.exception(), ServerGone)
        with pytest.raises(ServerGone, match="no session is open"):
            await session.ask(step)


@pytest.mark.parametrize("code", ERRORS)
@on_asyncio
async def test_an_error_of_the_server_is_one_of_the_env(code: str) -> None:
    async with one_env() as (server, group):
        server.fates.append(code)
        with pytest.raises(rl.EnvRaised, match=f"{code}: as it should not"):
            await group.step(steps_of("o-0"))
        await group.reset()
        batch, _ = await group.step(steps_of("o-0"))
        assert batch.observation[0]["count"] == 1


@pytest.mark.parametrize("option", [{"observation_field": "pixels"}, {"columns": {"pixels": 3}}])
@on_asyncio
async def test_a_field_that_the_server_does_not_send_is_named(option: dict[str, Any]) -> None:
    with pytest.raises(rl.EnvRaised, match=r"names 'pixels', .* are 'answers'"):
        async with one_env(env_kwargs=option):
            pass


@pytest.mark.parametrize("action", [3, {"number": object()}])
@on_asyncio
async def test_an_action_that_can_not_be_sent_is_refused_and_the_session_goes_on(
    action: Any,
) -> None:
    async with one_env() as (_, group):
        with pytest.raises(rl.BadAction, match="an action of env 'o-0' is"):
            await group.step(rl.BatchedData(["o-0"], [rl.PolicyResponse("o-0", action)]))
        batch, _ = await group.step(steps_of("o-0"))
        assert not batch.restarted.any()


@on_asyncio
async def test_sessions_that_are_lost_too_often_raise_and_the_next_step_tries_again() -> None:
    """As workers that die do."""
    async with one_env(max_restarts=1) as (server, group):
        server.fates.extend(["lost after", "ok", "lost after"])
        batch, _ = await group.step(steps_of("o-0"))
        assert batch.restarted.all()
        with pytest.raises(rl.EnvAway, match=f"lost its session: {server.url}.*max_restarts"):
            await group.step(steps_of("o-0"))
        batch, _ = await group.step(steps_of("o-0"))
        assert batch.restarted.all()
        batch, _ = await group.step(steps_of("o-0"))
        assert not batch.restarted.any()


@on_asyncio
async def test_other_messages_of_openenv_are_methods() -> None:
    async with one_env() as (_, group):
        await group.step(steps_of("o-0"))
        assert (await group["o-0"].call("state"))["step_count"] == 1
        assert await group["o-0"].call("mcp", "tools/list", {"a": 1}) == {"result": {"a": 1}}


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
        for socket in [*server.sockets]:
            await (await socket.ping())
        return len(server.sockets)

    def there(coroutine: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, loop).result(HANG)

    loop, server = asyncio.new_event_loop(), Misbehaving(capacity=ENVS)
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    there(server.__aenter__())
    try:
        config = {"name": "o", "backend": "openenv", "task": server.url, "num_workers": ENVS}
        async with rl.build_env_group(config) as group:
            await group.reset()
            assert len(group.get_workers()) == 1
            # It waits for the answers without its event loop, as a learner computes.
            assert there(ping_all()) == ENVS
            batch, _ = await group.step(steps_of(*group.env_ids))
            assert not batch.truncated.any()
    finally:
        there(server.__aexit__())
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@on_asyncio
async def test_envs_of_a_dead_server_move_to_another() -> None:
    async with Misbehaving(capacity=ENVS) as lasting:
        async with Misbehaving(capacity=ENVS) as dying:
            config = entry(dying.url, env_kwargs={"urls": [lasting.url]})
            group = rl.build_env_group(config)
            await group.init()
            await group.reset()
            assert len(dying.sessions) == len(lasting.sessions) == 2
        batch, _ = await group.step(steps_of(*group.env_ids))
        assert batch.restarted.tolist() == [True, False, True, False]
        batch, _ = await group.step(steps_of(*group.env_ids))
        assert not batch.restarted.any()
        assert len(lasting.sessions) == ENVS
        await group.close()


KEY = "Bearer tell-nobody"


def test_a_private_server_gets_headers_that_no_log_has(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """Nor has the output of a command; without them the server refuses, and is named."""
    with caplog.at_level(logging.DEBUG):
        asyncio.run(_use_private(tmp_path))
    assert KEY not in caplog.text
    # They hold connections, and so the frames of the error that has ended one, and its env.
    caplog.clear()


async def _use_private(folder: Path) -> None:
    async with Misbehaving(capacity=2, authorization=KEY) as server:
        config = entry(server.url, num_workers=2)
        config["env_kwargs"] = {"headers": {"Authorization": KEY}}
        async with rl.build_env_group(config) as group:
            await group.reset()
            batch, _ = await group.step(steps_of(*group.env_ids))
            assert batch.reward.tolist() == [1, 1]
        with start("check", write_config(folder, config), "--json") as check:
            printed, complaints = await asyncio.to_thread(check.communicate)
        (found,) = json.loads(printed)["entries"]
        assert found["action_space"] == "Anything()"
        assert KEY not in printed + complaints
        config["env_kwargs"] = {"connect_timeout": 0.01}
        async with rl.build_env_group(config) as group:
            with pytest.raises(rl.EnvRaised, match=f"{server.url} can't be reached: .*401"):
                await group.reset()


@pytest.mark.parametrize("headers", [{"A b": KEY}, {"Authorization": f"{KEY}\r\nX: 1"}], ids=str)
def test_headers_that_can_not_be_sent_are_refused(headers: dict[str, str]) -> None:
    """The error names the header and not its value."""
    config = entry("http://127.0.0.1:1", env_kwargs={"headers": headers})
    with pytest.raises(rl.ConfigError, match=r"headers: .*header") as failed:
        asyncio.run(rl.build_env_group(config).init())
    assert next(iter(headers)) in str(failed.value)
    assert KEY not in str(failed.value)


def test_a_server_that_is_not_there_is_named_by_check(tmp_path: Path) -> None:
    url = "http://127.0.0.1:1"
    config = entry(url, env_kwargs={"connect_timeout": 0.01})
    done = invoke("check", write_config(tmp_path, config))
    assert done.exit_code == 1
    assert url in done.stderr


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"columns": {"a": {"shap": [3]}}}, "columns.a"),
        ({"columns": {"a": 5}, "observation_field": "b"}, "exclude each other"),
        ({"url": "x", "colums": 1}, "url: .* did you mean 'urls'(?s:.*) mean 'columns'"),
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


@pytest.mark.parametrize(
    ("rewards", "expected"),
    [
        ([None, None, 1.0], [0.0, 0.0, 1.0]),
        ([0.5, None, None], [0.5, 0.0, 0.0]),
        ([None, 0, None], [0.0, 0.0, 0.0]),
        ([None, None, None], [0.0, 0.0, math.nan]),
    ],
)
@on_asyncio
async def test_an_episode_without_any_reward_has_none(
    monkeypatch: pytest.MonkeyPatch, rewards: list[float | None], expected: list[float]
) -> None:
    """A reward of 0 would look like a verdict."""
    left = list(rewards)
    executed = Misbehaving._executed

    def with_rewards(self: Any, session: Any, message: Any) -> Any:
        reply = executed(self, session, message)
        if message["type"] == "step":
            reply["data"] |= {"reward": left.pop(0), "done": not left}
        return reply

    monkeypatch.setattr(Misbehaving, "_executed", with_rewards)

    async with one_env() as (_, group):
        found = [(await group.step(steps_of("o-0")))[0].reward.item() for _ in rewards]
    assert np.array_equal(found, expected, equal_nan=True)
