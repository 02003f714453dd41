"""Fixtures that run one test on every placement and on both drivers."""

from __future__ import annotations

import asyncio
import inspect
import os
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pytest
import pytest_asyncio
import ray_cluster
from group import sample_envs
from group.awaitable import awaitable_twins
from patience import HANG

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio._core.group.drivers.aio_driver import AioDriver

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

assert sample_envs  # Registers its envs.


class Awaited:
    """A synchronous group or handle with the awaitable methods of the asynchronous one."""

    def __init__(self, wrapped: Any, like: type) -> None:
        self.wrapped = wrapped
        self._like = like

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self.wrapped, name)
        if name == "_driver":  # That of `calling`.
            return Awaited(attribute, AioDriver)
        if name == "_core":
            return attribute
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
    """Where envs live, and the driver that waits for them."""

    name: str
    fields: dict[str, Any]
    synchronous: bool = False
    awaitable: bool = False

    @property
    def inline(self) -> bool:
        return self.name == "inline"

    def build(self, entries: Any, **kwargs: Any) -> Any:
        """Build a group of `entries` in this place."""
        listed = entries if isinstance(entries, list) else [entries]
        fields = [self.fields] * len(listed)
        if self.name == "mixed" and len(listed) > 1:
            fields[-1] = INLINE.fields
        placed = [entry | own for entry, own in zip(listed, fields, strict=True)]
        with awaitable_twins() if self.awaitable else nullcontext():
            if self.synchronous:
                group = rlightning_aio.sync.build_env_group(placed, **kwargs)
                return Awaited(group, rlightning_aio.EnvGroup)
            return rlightning_aio.build_env_group(placed, **kwargs)


LOOP = Place("loop", {"placement": "loop"}, awaitable=True)
"""The envs' awaitable twins, on the trainer's event loop."""
INLINE = Place("inline", {"placement": "inline"})
INLINE_SYNC = Place("inline", {"placement": "inline"}, synchronous=True)
SEVERAL = Place("several workers", {"envs_per_process": 2})
MIXED_SYNC = Place("mixed", {"envs_per_process": 2}, synchronous=True)
"""Two envs in each worker, and the last of several entries in this process."""
# Each actor is a separate Python; on a busy machine, four of them may take minutes to start.
ON_ACTORS = {"placement": "ray", "num_cpus": 0, "start_timeout": HANG}
RAY = Place("ray", {**ON_ACTORS, "envs_per_process": 2})
RAY_SYNC = Place("ray", {**ON_ACTORS, "envs_per_process": 100}, synchronous=True)
# Ray needs a separate environment and takes minutes: `make test-ray`.
ON_RAY = "RLIGHTNING_AIO_ON_RAY" in os.environ
AWAITING = Place("awaiting workers", {"envs_per_process": 2}, synchronous=True, awaitable=True)
"""Awaitable envs in workers. Only `test_stepping` runs on them; it is representative."""
PLACES = [RAY, RAY_SYNC] if ON_RAY else [INLINE, INLINE_SYNC, MIXED_SYNC, SEVERAL, LOOP, AWAITING]


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


@pytest.fixture
def halved() -> Iterator[rlightning_aio.sync.EnvGroup]:
    """Yield a group of one inline env whose steps have two halves."""
    sample_envs.Halved.log.clear()
    with rlightning_aio.sync.build_env_group(sample_envs.HALVED) as group:
        yield group
