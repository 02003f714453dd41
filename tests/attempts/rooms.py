"""Places of the envs in `room`: fields of entries, groups and servers."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
import uvloop
from attempts.room import AwaitedRoom, Room
from kit.driven import ON_ACTORS

import rlightning_aio as rl
from rlightning_aio.plugins.openenv.server import OpenEnvServer

__all__ = ["PLACES", "openenv", "rooms", "serving"]


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
    return OpenEnvServer(group, "127.0.0.1", 0)
