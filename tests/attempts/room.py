"""Envs whose actions say what happens: a number is earned, a word is a deed.

Left out on purpose: whatever a test needs. Each worker imports this module, and pytest would take
ten times as long as everything else that a worker does to start.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import Any

from kit.scripted import Awaitable, Counts

from rlightning_aio.errors import EnvError
from rlightning_aio.spaces import Anything

__all__ = ["AwaitedRoom", "Room"]


class Room(Counts):
    """Its observation is the seed, the options and the number of steps; five steps end it."""

    observation_space = action_space = Anything()
    length = 5

    def does(self, action: Any) -> None:
        self.cut = action == "cut"
        if action == "raise":
            raise ValueError("as asked")
        if action == "blame":
            raise EnvError("a nonsensical action", blame="policy")
        if action == "die":
            os._exit(3)
        if action == "hang":
            time.sleep(3600)

    def step(self, action: Any) -> Any:
        observed, _, *others = super().step(action)
        earned = 0.0 if isinstance(action, str) else action
        return observed, earned["reward"] if isinstance(earned, dict) else float(earned), *others

    def observed(self) -> dict[str, Any]:
        return {"seed": self.seed, **self.options, "steps": self.steps}

    def mark(self, number: int = 0) -> int:
        """Leave a number behind; return what was left, at first 0."""
        self.number = number or getattr(self, "number", 0)
        return self.number


class AwaitedRoom(Awaitable):
    """The same with coroutines; a death is that of its process, so it has none."""

    def __init__(self) -> None:
        super().__init__(Room)

    async def pause(self, action: Any = None) -> None:
        seconds = action.get("seconds", 0) if isinstance(action, dict) else 0
        await asyncio.sleep(3600 if action == "hang" else seconds)

    async def mark(self, number: int = 0) -> int:
        """As of a room."""
        return self.env.mark(number)

    async def stall(self) -> None:
        """Something that does not return."""
        await asyncio.sleep(3600)
