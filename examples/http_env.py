"""An awaitable environment behind HTTP: a simulator of water tanks, and a controller's evaluation.

    pip install aiohttp
    python examples/http_env.py

A step costs the trainer nothing while the simulator computes.
"""

from __future__ import annotations

import asyncio
import uuid
from typing import Any

import aiohttp
import numpy as np
from aiohttp import web
from gymnasium import spaces

import rlightning_aio as rl
from rlightning_aio.evaluation import evaluate

levels: dict[str, float] = {}  # The simulator's tanks; it could be anywhere else.


async def change(request: web.Request) -> web.Response:
    """Set the level of a tank, or open its valve."""
    tank, asked = request.match_info["tank"], await request.json()
    await asyncio.sleep(0.005)  # It computes.
    if "level" in asked:
        levels[tank] = asked["level"]
    else:
        levels[tank] += 0.5 * asked["valve"] - 0.05
    return web.json_response({"level": levels[tank]})


class Tank:
    """Keep the level of a tank at 0, while it leaks."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    session: aiohttp.ClientSession | None = None

    def __init__(self, url: str) -> None:
        self.url = f"{url}/tanks/{uuid.uuid4()}"

    async def ask(self, **body: float) -> Any:
        if self.session is None:  # Made here, because a session belongs to an event loop.
            self.session = aiohttp.ClientSession()
        async with self.session.post(self.url, json=body) as response:
            response.raise_for_status()
            return np.array([(await response.json())["level"]], np.float32)

    async def reset(self, *, seed: int | None = None, **_: Any) -> Any:
        self.steps = 0
        return await self.ask(level=float(np.random.default_rng(seed).normal())), {}

    async def step(self, action: Any) -> Any:
        self.steps += 1
        level = await self.ask(valve=float(action[0]))
        return level, -abs(float(level[0])), False, self.steps == 10, {}

    async def close(self) -> None:
        if self.session is not None:
            await self.session.close()


def controller(batch: Any) -> Any:
    return np.clip(-2 * batch.observation, -1, 1).astype(np.float32)


async def main() -> None:
    app = web.Application()
    app.add_routes([web.post("/tanks/{tank}", change)])
    runner = web.AppRunner(app)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    url = f"http://127.0.0.1:{runner.addresses[0][1]}"
    limits: dict[str, Any] = {"step_timeout": 10, "max_concurrency": 8}
    async with rl.build_env_group(
        Tank, num_workers=16, placement="loop", env_kwargs={"url": url}, **limits
    ) as group:
        found = await evaluate(group, controller, episodes=4, seed=1000)
    await runner.cleanup()
    print(f"{found.total_reward.mean:.2f} in {found.total_reward.count} episodes")


if __name__ == "__main__":
    rl.run(main())
