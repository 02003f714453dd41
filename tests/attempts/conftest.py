"""The places of attempts: each host, OpenEnv's sessions, and on Ray (`make test-ray`) actors."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest_asyncio
import uvloop
from attempts.rooms import PLACES, openenv, rooms, serving
from group import conftest as on_group

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import pytest

if on_group.ON_RAY:
    ray_nodes = on_group.ray_nodes
    nothing_left_behind = on_group.nothing_left_behind


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect servers on uvloop (see `serving`), which would start only to be skipped; on Ray,
    what doesn't hold for every place, and one of the two loops.
    """
    on_group.deselect(config, items, Path(__file__).parent, _is_other)


def _is_other(item: pytest.Item) -> bool:
    params = item.callspec.params if hasattr(item, "callspec") else {}
    if on_group.ON_RAY:
        return "place" not in params or asyncio.new_event_loop in params.values()
    return params.get("place") == "openenv" and uvloop.new_event_loop in params.values()


@pytest_asyncio.fixture(params=[name for name in PLACES if (name == "ray") == on_group.ON_RAY])
async def place(request: pytest.FixtureRequest) -> AsyncIterator[dict[str, Any]]:
    """Fields of an entry."""
    if request.param != "openenv":
        yield PLACES[request.param]
        return
    async with rooms(PLACES["workers"]) as group, serving(group) as server:
        yield openenv(server.url)
