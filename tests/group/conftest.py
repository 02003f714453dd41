"""One test for all places where envs may live and for both drivers."""

from __future__ import annotations

import asyncio
import inspect
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pytest
import pytest_asyncio
import ray_cluster
from group import sample_envs
from patience import HANG

import rlightning_aio
import rlightning_aio.sync

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

assert sample_envs  # Registers its envs.


class Awaited:
    """A synchronous group or handle whose methods may be awaited where the others' must be."""

    def __init__(self, wrapped: Any, like: type) -> None:
        self.wrapped = wrapped
        self._like = like

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self.wrapped, name)
        if not inspect.iscoroutinefunction(getattr(self._like, name)):
            return attribute

        async def awaited(*args: Any, **kwargs: Any) -> Any:
            return attribute(*args, **kwargs)

        return awaited

    def __len__(self) -> int:
        return len(self.wrapped)

    def __getitem__(self, env_id: str) -> Awaited:
        return Awaited(self.wrapped[env_id], rlightning_aio.EnvHandle)

    async def __aenter__(self) -> Self:
        self.wrapped.__enter__()
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.wrapped.__exit__(*exc)


@dataclass(frozen=True)
class Place:
    """Where envs live, and which driver waits for them."""

    name: str
    fields: dict[str, Any]
    synchronous: bool = False

    @property
    def inline(self) -> bool:
        return self.name == "inline"

    def build(self, entries: Any, **kwargs: Any) -> Any:
        """A group of `entries`, each put in this place."""
        listed = entries if isinstance(entries, list) else [entries]
        placed = [{**entry, **self.fields} for entry in listed]
        if self.synchronous:
            group = rlightning_aio.sync.build_env_group(placed, **kwargs)
            return Awaited(group, rlightning_aio.EnvGroup)
        return rlightning_aio.build_env_group(placed, **kwargs)


INLINE = Place("inline", {"placement": "inline"})
INLINE_SYNC = Place("inline", {"placement": "inline"}, synchronous=True)
SEVERAL = Place("several workers", {"envs_per_process": 2})
SPLIT_SYNC = Place("split", {"placement": "split", "envs_per_process": 2}, synchronous=True)
"""Two envs in each worker, and the last two in this process."""
# Each actor is a Python of its own; on a busy machine, four of them may take minutes to start.
ON_ACTORS = {"placement": "ray", "num_cpus": 0, "start_timeout": HANG}
RAY = Place("ray", {**ON_ACTORS, "envs_per_process": 2})
RAY_SYNC = Place("ray", {**ON_ACTORS, "envs_per_process": 100}, synchronous=True)
# Ray takes an environment and some minutes of its own: `make test-ray`.
ON_RAY = "RLIGHTNING_AIO_ON_RAY" in os.environ
PLACES = [RAY, RAY_SYNC] if ON_RAY else [INLINE, INLINE_SYNC, SPLIT_SYNC, SEVERAL]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """On Ray, run what is said of every place, once for each facade, and nothing else."""
    here = Path(__file__).parent
    other = [item for item in items if ON_RAY and here in item.path.parents and _is_other(item)]
    config.hook.pytest_deselected(items=other)
    items[:] = [item for item in items if item not in other]


def _is_other(item: pytest.Item) -> bool:
    params = item.callspec.params if hasattr(item, "callspec") else {}
    place = params.get("place")
    on_asyncio = any(value is asyncio.new_event_loop for value in params.values())
    return place is None or (on_asyncio and not place.synchronous)


if ON_RAY:

    @pytest.fixture(scope="session", autouse=True)
    def ray_nodes() -> Iterator[None]:
        with ray_cluster.cluster(num_cpus=4):
            yield

    @pytest.fixture(autouse=True)
    def nothing_left_behind() -> Iterator[None]:
        """Ray keeps connections open for a while, so that descriptors tell nothing."""
        yield
        ray_cluster.no_actor_left()


@pytest.fixture(params=PLACES, ids=lambda p: f"{p.name}{', sync' if p.synchronous else ''}")
def place(request: pytest.FixtureRequest) -> Place:
    """Each host and each driver; the synchronous one thereby inside of a running loop."""
    return request.param


@pytest_asyncio.fixture
async def start(place: Place) -> AsyncIterator[Any]:
    """Start a group of some entries in the place; it is closed after the test."""
    groups: list[Any] = []

    async def start(entries: Any, **kwargs: Any) -> Any:
        groups.append(place.build(entries, **kwargs))
        await groups[-1].init()
        return groups[-1]

    yield start
    while groups:
        await groups.pop().close()


@pytest.fixture
def halved() -> Iterator[rlightning_aio.sync.EnvGroup]:
    """A group of one inline env whose steps have two halves."""
    sample_envs.Halved.log.clear()
    with rlightning_aio.sync.build_env_group(sample_envs.HALVED) as group:
        yield group
