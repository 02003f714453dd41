"""`OpenEnvServer`, with the `openenv` backend as its client."""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
from typing import TYPE_CHECKING, Any

import aiohttp
import gymnasium as gym
import numpy as np
import pytest
from cli.command import start, write_config
from envs.test_openenv import on_asyncio
from kit.scripted import HANG, Counts, Scripted
from websockets.asyncio.client import connect

import rlightning_aio as rl
from rlightning_aio.plugins.openenv.server import OpenEnvServer
from rlightning_aio.plugins.openenv.session import get_json, post_json
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

POLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "placement": "inline"}
COLUMN = {"columns": {"observation": {"shape": [4]}}, "truncated_field": "truncated"}


def client_of(server: OpenEnvServer, count: int) -> dict[str, Any]:
    entry = {"name": "far", "backend": "openenv", "task": server.url, "placement": "loop"}
    return {**entry, "num_workers": count, "env_kwargs": COLUMN}


@on_asyncio
async def test_episodes_over_the_network_equal_those_of_the_env() -> None:
    async with (
        rl.build_env_group({**POLE, "num_workers": 2, "max_episode_steps": 15}) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
        rl.build_env_group(client_of(server, 2)) as group,
        group.auto_reset(math.inf),
    ):
        plain = [gym.make("CartPole-v1", max_episode_steps=15) for _ in range(2)]
        batch, _ = await group.reset(seed=[11, 12])
        firsts = [env.reset(seed=11 + k)[0] for k, env in enumerate(plain)]
        np.testing.assert_array_equal(batch.observation["observation"], firsts)
        ended = np.zeros(2, bool)
        for number in range(15):
            action = number // 2 % 2
            batch, _ = await group.step(batch.respond(action=[{"action": action}] * 2))
            for k, env in enumerate(plain):
                if ended[k]:
                    continue
                observation, reward, terminated, truncated, _ = env.step(action)
                np.testing.assert_array_equal(batch.observation["observation"][k], observation)
                assert batch.reward[k] == reward
                assert (batch.terminated[k], batch.truncated[k]) == (terminated, truncated)
                ended[k] = terminated or truncated
        assert ended.all()


@on_asyncio
async def test_its_envs_are_described() -> None:
    async with (
        rl.build_env_group(POLE) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        assert await asyncio.to_thread(get_json, server.url, "/health") == {"status": "healthy"}
        assert (await asyncio.to_thread(get_json, server.url, "/metadata"))["name"] == "pole"
        schema = await asyncio.to_thread(get_json, server.url, "/schema")
    assert schema["action"]["properties"]["action"] == {
        "type": "integer",
        "minimum": 0,
        "maximum": 1,
    }
    assert schema["observation"]["properties"]["observation"]["minItems"] == 4
    # A client that has only one value sends it as the only required field.
    assert schema["action"]["required"] == ["action"]
    assert schema["observation"]["required"] == ["observation"]


@on_asyncio
async def test_invalid_messages_do_not_change_the_session() -> None:
    """A client that exceeds the number of sessions gets an error."""

    async def ask(text: str) -> Any:
        await socket.send(text)
        return json.loads(await socket.recv())

    async with (
        rl.build_env_group(POLE) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        address = server.url.replace("http", "ws") + "/ws"
        async with connect(address, proxy=None) as socket:
            await ask('{"type": "reset", "data": {"seed": 1, "episode_id": "e"}}')
            codes = [
                (await ask(text))["data"]["code"]
                for text in (
                    "{",
                    '{"type": "dance"}',
                    '{"type": "step", "data": {"act": 1}}',
                    '{"type": "step", "data": {"action": [1, 2]}}',
                    '{"type": "step", "data": {"action": 0.7}}',
                    '{"type": "step", "data": {"action": 1e300}}',
                    '{"type": "step", "data": {"action": 1' + "0" * 40 + "}}",
                    '{"type": "reset", "data": "abc"}',
                )
            ]
            assert codes == [
                "INVALID_JSON",
                "UNKNOWN_TYPE",
                *["VALIDATION_ERROR"] * 6,
            ]
            assert (await ask('{"type": "step", "data": {"action": 1}}'))["data"]["reward"] == 1
            state = await ask('{"type": "state"}')
            assert state["data"] == {"episode_id": "e", "step_count": 1}
            async with connect(address, proxy=None) as second:
                refusal = json.loads(await second.recv())
            assert refusal["data"]["code"] == "CAPACITY_REACHED"
        for _ in range(100):
            async with connect(address, proxy=None) as socket:
                answer = await ask('{"type": "step", "data": {"action": 1}}')
                if answer["data"]["code"] == "CAPACITY_REACHED":
                    continue
                assert "reset it first" in answer["data"]["message"]
                assert (await ask('{"type": "reset"}'))["type"] == "observation"
                return
        pytest.fail("the session's env was not given back")


class Unstable(Counts):
    """Its observations hold NaN and infinity; action 1 has a reward of NaN."""

    observation_space = Anything()

    def does(self, action: Any) -> float:
        return math.nan if action else 1.0

    def observed(self) -> Any:
        return {"place": np.array([1, np.nan, np.inf], np.float32), "note": [-math.inf]}

    def told(self) -> dict[str, Any]:
        return {"speed": np.float64("nan"), "spread": np.full(2, np.nan)}


@on_asyncio
async def test_its_frames_are_json() -> None:
    """NaN and infinity of observations and infos are null; such a reward is an error."""

    def loaded(text: str | bytes) -> Any:
        return json.loads(text, parse_constant=pytest.fail)

    async def ask(kind: str, **data: Any) -> Any:
        await socket.send(json.dumps({"type": kind, "data": data}))
        return loaded(await socket.recv())

    entry = {"name": "unstable", "task": Unstable, "placement": "inline"}
    async with (
        rl.build_env_group(entry) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
        connect(server.url.replace("http", "ws") + "/ws", proxy=None) as socket,
    ):
        for kind, data in (("reset", {"episode_id": math.nan}), ("step", {"action": 0})):
            reply = (await ask(kind, **data))["data"]
            assert reply["observation"] == {"place": [1.0, None, None], "note": [None]}
            assert reply["metadata"] == {"speed": None, "spread": [None, None]}
        assert (await ask("state"))["data"]["episode_id"] is None
        refused = (await ask("step", action=1))["data"]
        assert refused["code"] == "EXECUTION_ERROR"
        assert "reward of env 'unstable-0' is nan" in refused["message"]
        async with (
            aiohttp.ClientSession() as session,
            session.post(f"{server.url}/mcp", data='{"id": NaN}') as answer,
        ):
            assert loaded(await answer.text())["id"] is None


async def rpc(server: OpenEnvServer, method: str, **params: Any) -> Any:
    """Return the result or the code of the error."""
    request = {"jsonrpc": "2.0", "id": 7, "method": method, "params": params}
    answer = await post_json(f"{server.url}/mcp", request)
    assert (answer["jsonrpc"], answer["id"]) == ("2.0", 7)
    return answer["result"] if "result" in answer else answer["error"]["code"]


@on_asyncio
async def test_tools_are_answered_as_by_an_environment_without_any() -> None:
    async with (
        rl.build_env_group(POLE) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        assert await rpc(server, "tools/list") == -32603
        assert await rpc(server, "tools/call", name="add") == -32603
        assert await rpc(server, "dance") == -32601
        assert (await post_json(f"{server.url}/mcp", {}))["error"]["code"] == -32600
        with pytest.raises(ConnectionError, match="404"):
            await post_json(f"{server.url}/step", {})
        async with connect(server.url.replace("http", "ws") + "/ws", proxy=None) as socket:
            data = {"jsonrpc": "2.0", "id": 1, "method": "tools/list"}
            await socket.send(json.dumps({"type": "mcp", "data": data}))
            reply = json.loads(await socket.recv())
        assert reply["type"] == "mcp"
        assert reply["data"]["error"]["message"] == "Environment does not support MCP"


@on_asyncio
async def test_a_session_without_a_connection_ends_by_itself() -> None:
    """Whether it had one or not, its env is free again; one that has a connection goes on."""

    async def until_free() -> str:
        while isinstance(  # noqa: ASYNC110
            created := await rpc(server, "openenv/session/create"), int
        ):
            await asyncio.sleep(0.01)
        return created["session_id"]

    async def ask(text: str) -> Any:
        await socket.send(text)
        return json.loads(await socket.recv())

    async with (
        rl.build_env_group({**POLE, "num_workers": 2}) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        address = server.url.replace("http", "ws") + "/ws?session_id="
        kept = await until_free()
        server._session_timeout = 0.01
        async with connect(address + kept, proxy=None) as socket:
            await ask('{"type": "reset"}')
            never_attached = [await until_free() for _ in range(3)]
            assert (await ask('{"type": "step", "data": {"action": 1}}'))["data"]["reward"] == 1
        for _ in range(2):
            await until_free()
        for key in (kept, *never_attached):
            async with connect(address + key, proxy=None) as socket:
                refusal = json.loads(await socket.recv())
            assert refusal["data"]["message"] == f"Unknown session_id: {key}"


@on_asyncio
async def test_a_kept_session_whose_step_never_ends_ends_by_itself() -> None:
    """Its client is gone, and never closes it; the step is aborted, and its env is free again."""
    async with (
        rl.build_env_group(Scripted, name="stuck") as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        created: Any = await rpc(server, "openenv/session/create")
        address = server.url.replace("http", "ws") + f"/ws?session_id={created['session_id']}"
        async with connect(address, proxy=None) as socket:
            await socket.send('{"type": "reset"}')
            await socket.recv()
            server._session_timeout = 0.01
            await socket.send(json.dumps({"type": "step", "data": {"action": HANG}}))
            while not served.pending:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        while isinstance(  # noqa: ASYNC110
            await rpc(server, "openenv/session/create"), int
        ):
            await asyncio.sleep(0.01)
        assert served.pending == []


@on_asyncio
async def test_a_created_session_outlives_its_socket() -> None:
    async with (
        rl.build_env_group(POLE) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        key = (await rpc(server, "openenv/session/create"))["session_id"]
        assert await rpc(server, "openenv/session/create") == -32000
        address = server.url.replace("http", "ws") + f"/ws?session_id={key}"
        async with connect(address, proxy=None) as socket:
            await socket.send('{"type": "reset", "data": {"seed": 1}}')
            await socket.recv()
            await socket.send('{"type": "step", "data": {"action": 1}}')
            await socket.recv()
            async with connect(address, proxy=None) as second:
                assert (
                    "already has an attached" in json.loads(await second.recv())["data"]["message"]
                )
            answer = await rpc(server, "openenv/session/close", session_id=key)
            assert answer == {"session_id": key, "closed": False, "closing": True}
        while isinstance(  # noqa: ASYNC110
            created := await rpc(server, "openenv/session/create"), int
        ):
            await asyncio.sleep(0)  # The server has still to see the socket close.
        key = created["session_id"]
        assert (await rpc(server, "openenv/session/close", session_id=key))["closed"]
        assert await rpc(server, "openenv/session/close", session_id=key) == -32602


KEY = "Bearer tell-nobody"


@contextlib.asynccontextmanager
async def private(url: str) -> AsyncGenerator[tuple[str, list[bytes]]]:
    """Relay connections that have the key; yields the address and the heads of their requests."""
    heads: list[bytes] = []
    port = int(url.rpartition(":")[2])

    async def copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            writer.write(data)
        writer.close()

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        key = f"Authorization: {KEY}\r\n".encode()
        if key not in head:
            writer.write(b"HTTP/1.1 401 Unauthorized\r\nContent-Length: 0\r\n\r\n")
            writer.close()
            return
        heads.append(head)
        back, forth = await asyncio.open_connection("127.0.0.1", port)
        forth.write(head.replace(key, b""))
        await asyncio.gather(copy(reader, forth), copy(back, writer), return_exceptions=True)

    async with await asyncio.start_server(relay, "127.0.0.1", 0) as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}", heads


@pytest.mark.parametrize("session", ["own", "keep"])
def test_a_private_server_gets_headers_that_no_log_has(
    session: str, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """Both over WebSockets and over HTTP; without them it refuses, and is named."""
    with caplog.at_level(logging.DEBUG):
        asyncio.run(_use_private(session, tmp_path))
    assert KEY not in caplog.text
    libraries = {record.name.partition(".")[0] for record in caplog.records}
    assert libraries & {"aiohttp", "websockets"}
    # They hold connections, and so the frames of the error that has ended one, and its env.
    caplog.clear()


async def _use_private(session: str, folder: Path) -> None:
    async with (
        rl.build_env_group({**POLE, "num_workers": 2}) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
        private(server.url) as (url, heads),
    ):
        config = client_of(server, 2)
        config |= {"task": url, "env_kwargs": {**COLUMN, "session": session}}
        config["env_kwargs"] |= {"headers": {"Authorization": KEY}}
        async with rl.build_env_group(config) as group:
            batch, _ = await group.reset(seed=[3, 4])
            batch, _ = await group.step(batch.respond(action=[{"action": 1}] * 2))
            assert batch.reward.tolist() == [1, 1]
        calls = sorted({head.split(b" ")[1].partition(b"?")[0] for head in heads})
        assert calls == ([b"/mcp", b"/ws"] if session == "keep" else [b"/ws"])
        with start("check", write_config(folder, config), "--json") as check:
            printed, complaints = await asyncio.to_thread(check.communicate)
        assert "schema" in json.loads(printed)["entries"][0]["offers"]
        assert KEY not in printed + complaints
        config["env_kwargs"] |= {"headers": {}, "connect_timeout": 0.01}
        async with rl.build_env_group(config) as group:
            with pytest.raises(rl.EnvRaised, match=f"{url} can't be reached: .*401"):
                await group.reset()


@pytest.mark.parametrize("headers", [{"A b": KEY}, {"Authorization": f"{KEY}\r\nX: 1"}], ids=str)
def test_headers_that_can_not_be_sent_are_refused(headers: dict[str, str]) -> None:
    """The error names the header and not its value."""
    entry = {"name": "far", "backend": "openenv", "task": "http://127.0.0.1:1"}
    config = {**entry, "placement": "loop", "env_kwargs": {"headers": headers}}
    with pytest.raises(rl.ConfigError, match=r"headers: .*header") as failed:
        asyncio.run(rl.build_env_group(config).init())
    assert next(iter(headers)) in str(failed.value)
    assert KEY not in str(failed.value)


@on_asyncio
async def test_kept_sessions_of_the_backend_are_those_of_the_server() -> None:
    async with (
        rl.build_env_group({**POLE, "num_workers": 2}) as served,
        OpenEnvServer(served, "127.0.0.1", 0) as server,
    ):
        config = client_of(server, 2)
        config["env_kwargs"] = {**COLUMN, "session": "keep"}
        for _ in range(2):  # The first group has left no session behind.
            async with rl.build_env_group(config) as group:
                batch, _ = await group.reset(seed=[3, 4])
                batch, _ = await group.step(batch.respond(action=[{"action": 1}] * 2))
                assert batch.reward.tolist() == [1, 1]
