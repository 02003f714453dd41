"""The places of attempts: each host, and on Ray (`make test-ray`) actors."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from attempts.rooms import PLACES
from group import conftest as on_group

if on_group.ON_RAY:
    ray_nodes = on_group.ray_nodes
    nothing_left_behind = on_group.nothing_left_behind


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """On Ray, deselect what doesn't hold for every place, and one of the two loops."""
    on_group.deselect(config, items, Path(__file__).parent, _is_other)


def _is_other(item: pytest.Item) -> bool:
    params = item.callspec.params if hasattr(item, "callspec") else {}
    return on_group.ON_RAY and ("place" not in params or asyncio.new_event_loop in params.values())


@pytest.fixture(params=[name for name in PLACES if (name == "ray") == on_group.ON_RAY])
def place(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Fields of an entry."""
    return PLACES[request.param]
