"""Print episodes of OpenEnv's own `GenericEnvClient` as JSON.

Usage: openenv_client.py URL COUNT
"""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Any

from openenv import GenericEnvClient


async def episode(url: str, seed: int) -> list[Any]:
    async with GenericEnvClient(base_url=url) as env:
        result = await env.reset(seed=seed)
        rows: list[Any] = [result.observation["observation"]]
        while not result.done:
            result = await env.step({"action": len(rows) % 2})
            rows.append([result.observation["observation"], result.reward, result.done])
        assert (await env.state())["step_count"] == len(rows) - 1
        return rows


async def main(url: str, count: int) -> list[Any]:
    return await asyncio.gather(*(episode(url, seed) for seed in range(count)))


print(json.dumps(asyncio.run(main(sys.argv[1], int(sys.argv[2])))))  # noqa: T201
