"""Places of the envs in `room`: fields of entries, and groups."""

from __future__ import annotations

from typing import Any

from attempts.room import AwaitedRoom, Room
from kit.driven import ON_ACTORS

import rlightning_aio as rl

__all__ = ["PLACES", "rooms"]


PLACES: dict[str, dict[str, Any]] = {
    "loop": {"task": AwaitedRoom, "placement": "loop"},
    "awaitable in workers": {"task": AwaitedRoom, "envs_per_process": 2},
    "workers": {"task": Room, "envs_per_process": 1},
    "shared workers": {"task": Room, "envs_per_process": 2},
    "inline": {"task": Room, "placement": "inline"},
    "ray": {"task": Room, **ON_ACTORS, "envs_per_process": 1},
}
"""Fields of entries."""


def rooms(place: dict[str, Any], num_workers: int = 4, **fields: Any) -> rl.EnvGroup:
    """A group that was not started."""
    return rl.build_env_group(name="room", num_workers=num_workers, **place, **fields)
