"""Fixtures that run one test on every placement and on both drivers."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio
import ray_cluster
from group import sample_envs
from kit.driven import AWAITING, ON_RAY, PLACES, Place

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

assert sample_envs  # Registers its envs.


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect redundant tests: on Ray, those that don't hold for every placement."""
    deselect(config, items, Path(__file__).parent, _is_other)


def deselect(
    config: pytest.Config,
    items: list[pytest.Item],
    folder: Path,
    is_other: Callable[[pytest.Item], bool],
) -> None:
    """Deselect the tests of a folder that a function returns True for."""
    other = [item for item in items if folder in item.path.parents and is_other(item)]
    config.hook.pytest_deselected(items=other)
    items[:] = [item for item in items if item not in other]


def _is_other(item: pytest.Item) -> bool:
    params = item.callspec.params if hasattr(item, "callspec") else {}
    place = params.get("place")
    if not ON_RAY:
        return place is AWAITING and item.path.stem != "test_stepping"
    on_asyncio = any(value is asyncio.new_event_loop for value in params.values())
    return not isinstance(place, Place) or (on_asyncio and not place.synchronous)


if ON_RAY:

    @pytest.fixture(scope="session", autouse=True)
    def ray_nodes() -> Iterator[None]:
        with ray_cluster.cluster(num_cpus=4):
            yield

    @pytest.fixture(autouse=True)
    def nothing_left_behind() -> Iterator[None]:
        """Check only for actors: Ray keeps connections open, so descriptors show nothing."""
        yield
        ray_cluster.no_actor_left()


@pytest.fixture(params=PLACES, ids=lambda p: f"{p.name}{', sync' if p.synchronous else ''}")
def place(request: pytest.FixtureRequest) -> Place:
    """Each placement with each driver; the synchronous driver runs inside a running loop."""
    return request.param


@pytest_asyncio.fixture
async def start(place: Place) -> AsyncIterator[Any]:
    """Start groups of given entries in the place, and close them after the test."""
    groups: list[Any] = []

    async def start(entries: Any, **kwargs: Any) -> Any:
        groups.append(place.build(entries, **kwargs))
        await groups[-1].init()
        return groups[-1]

    yield start
    while groups:
        await groups.pop().close()
