"""Envs whose actions say what happens: a number is earned, a word is a deed; and their places."""

from __future__ import annotations

import asyncio
import os
import time
from typing import Any

import gymnasium as gym
import pytest
import uvloop
from group.conftest import ON_ACTORS

import rlightning_aio as rl
from rlightning_aio.errors import EnvError
from rlightning_aio.serving import OpenEnvServer
from rlightning_aio.spaces import Anything

__all__ = ["PLACES", "AwaitedRoom", "Room", "openenv", "rooms", "serving"]


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
        self.steps += 1
        return self._observed(), float(action), self.steps == 5, action == "cut", {}

    def tool(self, number: int) -> int:
        """Something to call."""
        return 2 * number

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


class AwaitedRoom:
    """The same with coroutines; a death is that of its process, so it has none."""

    observation_space = Anything()
    action_space = Anything()

    def __init__(self) -> None:
        self.room = Room()

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await asyncio.sleep(0)
        if options is not None and options.get("reset") == "hang":
            await asyncio.sleep(3600)
        return self.room.reset(seed=seed, options=options)

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0)
        if action == "hang":
            await asyncio.sleep(3600)
        return self.room.step(action)

    async def tool(self, number: int) -> int:
        """Something to call."""
        return self.room.tool(number)

    async def stall(self) -> None:
        """Something that does not return."""
        await asyncio.sleep(3600)


PLACES: dict[str, dict[str, Any]] = {
    "loop": {"task": AwaitedRoom, "placement": "loop"},
    "awaitable in workers": {"task": AwaitedRoom, "envs_per_process": 2},
    "workers": {"task": Room, "envs_per_process": 1},
    "shared workers": {"task": Room, "envs_per_process": 2},
    "inline": {"task": Room, "placement": "inline"},
    "openenv": {},
    "ray": {"task": Room, **ON_ACTORS, "envs_per_process": 1},
}
"""Fields of entries; those of ``openenv`` name a server: see `openenv`."""


def openenv(url: str, **kwargs: Any) -> dict[str, Any]:
    """Sessions of a server of rooms."""
    fields = {"action_field": "action", "truncated_field": "truncated"}
    return {"backend": "openenv", "task": url, "env_kwargs": {**fields, **kwargs}}


def rooms(place: dict[str, Any], num_workers: int = 4, **fields: Any) -> rl.EnvGroup:
    """A group that was not started."""
    return rl.build_env_group(name="room", num_workers=num_workers, **place, **fields)


def serving(group: rl.EnvGroup) -> OpenEnvServer:
    """A server of its envs."""
    if isinstance(asyncio.get_running_loop(), uvloop.Loop):
        pytest.skip("it keeps a descriptor of a server")
    return OpenEnvServer(group, "room", "127.0.0.1", 0)
