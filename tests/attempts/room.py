"""Envs whose actions say what happens: a number is earned, a word is a deed.

Left out on purpose: whatever a test needs. Each worker imports this module, and pytest would take
ten times as long as everything else that a worker does to start.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import Any

import gymnasium as gym
from kit.scripted import Awaitable

from rlightning_aio.errors import EnvError
from rlightning_aio.spaces import Anything

__all__ = ["AwaitedRoom", "Room"]


class Room(gym.Env[Any, Any]):
    """Its observation is the seed, the options and the number of steps; five steps end it."""

    observation_space = Anything()
    action_space = Anything()

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.told: dict[str, Any] = {"seed": seed, **(options or {}), "pid": os.getpid()}
        self.steps = 0
        if (deed := self.told.get("reset")) is not None:
            self._do(deed)
        return self._observed(), {}

    def step(self, action: Any) -> Any:
        if isinstance(action, str):
            self._do(action)
            action = 0.0
        reward = action["reward"] if isinstance(action, dict) else float(action)
        self.steps += 1
        return self._observed(), reward, self.steps == 5, action == "cut", {}

    def tool(self, number: int) -> int:
        """Something to call."""
        return 2 * number

    def mark(self, number: int = 0) -> int:
        """Leave a number behind; return what was left, at first 0."""
        self.number = number or getattr(self, "number", 0)
        return self.number

    def stall(self) -> None:
        """Something that does not return."""
        time.sleep(3600)

    def _observed(self) -> dict[str, Any]:
        return {**self.told, "steps": self.steps}

    def _do(self, deed: str) -> None:
        if deed == "raise":
            raise ValueError("as asked")
        if deed == "blame":
            raise EnvError("a nonsensical action", blame="policy")
        if deed == "die":
            os._exit(3)
        if deed == "hang":
            time.sleep(3600)


class AwaitedRoom(Awaitable):
    """The same with coroutines; a death is that of its process, so it has none."""

    def __init__(self) -> None:
        super().__init__(Room)

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await self.pause((options or {}).get("reset"))
        return await super().reset(seed=seed, options=options)

    async def pause(self, action: Any = None) -> None:
        seconds = action.get("seconds", 0) if isinstance(action, dict) else 0
        await asyncio.sleep(3600 if action == "hang" else seconds)

    async def tool(self, number: int) -> int:
        """Something to call."""
        return self.env.tool(number)

    async def mark(self, number: int = 0) -> int:
        """As of a room."""
        return self.env.mark(number)

    async def stall(self) -> None:
        """Something that does not return."""
        await asyncio.sleep(3600)
