"""Print episodes of OpenEnv's own clients as JSON.

Usage: openenv_client.py URL COUNT

Each kind plays one episode with each seed: `generic` is its client for any environment, `sync` the
same without `await`, and `mcp` the one for tools, whose sessions are created over HTTP.
"""

# It runs in a Python of its own, with packages that are not here.
# pyright: basic, reportMissingImports=false

from __future__ import annotations

import asyncio
import json
import sys
from typing import Any

from openenv import GenericEnvClient
from openenv.core.env_server.types import Action
from openenv.core.mcp_client import MCPToolClient


class Push(Action):
    action: int


def row(result: Any) -> list[Any]:
    seen = result.observation
    fields = seen if isinstance(seen, dict) else seen.model_dump()
    return [fields["observation"], result.reward, result.done]


async def episode(client: Any, seed: int) -> list[Any]:
    is_mcp = isinstance(client, MCPToolClient)
    async with client as env:
        rows = [row(await env.reset(seed=seed))]
        if is_mcp:
            assert await env.list_tools() == []
        while not rows[-1][2]:
            number = len(rows) % 2
            rows.append(row(await env.step(Push(action=number) if is_mcp else {"action": number})))
        state = await env.state()
        assert (state.step_count if is_mcp else state["step_count"]) == len(rows) - 1
        return rows


def episode_without_await(client: Any, seed: int) -> list[Any]:
    with client.sync() as env:
        rows = [row(env.reset(seed=seed))]
        while not rows[-1][2]:
            rows.append(row(env.step({"action": len(rows) % 2})))
        assert env.state()["step_count"] == len(rows) - 1
        return rows


async def episodes(kind: Any, url: str, count: int) -> list[Any]:
    return await asyncio.gather(*(episode(kind(base_url=url), seed) for seed in range(count)))


def main(url: str, count: int) -> dict[str, list[Any]]:
    return {
        "generic": asyncio.run(episodes(GenericEnvClient, url, count)),
        "sync": [episode_without_await(GenericEnvClient(base_url=url), k) for k in range(count)],
        "mcp": asyncio.run(episodes(MCPToolClient, url, count)),
    }


print(json.dumps(main(sys.argv[1], int(sys.argv[2]))))  # noqa: T201
