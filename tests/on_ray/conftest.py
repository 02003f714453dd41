"""One cluster for all of these tests; none of them may leave an actor behind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import ray_cluster
from group import sample_envs
from kit.driven import Place

if TYPE_CHECKING:
    from collections.abc import Iterator

assert sample_envs  # Registers its envs.


@pytest.fixture(scope="session")
def nodes() -> Iterator[Any]:
    with ray_cluster.cluster(num_cpus=4) as made:
        yield made


@pytest.fixture(autouse=True)
def nothing_left_behind(nodes: Any) -> Iterator[None]:
    """Ray keeps connections open for a while, so that descriptors tell nothing."""
    yield
    ray_cluster.no_actor_left()
    ray_cluster.dead_nodes_missed(nodes)


FACADES = [Place("wherever", {}), Place("wherever", {}, synchronous=True)]


@pytest.fixture(params=FACADES, ids=["async", "sync"])
def facade(request: pytest.FixtureRequest) -> Place:
    """Groups of either facade, whose methods are awaited; the entries say where they live."""
    return request.param


@pytest.fixture(params=FACADES[1:], ids=["sync"])
def sync_facade(request: pytest.FixtureRequest) -> Place:
    """For what has nothing to do with who waits."""
    return request.param
