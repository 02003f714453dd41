"""A Ray cluster of a few nodes on this machine, one for all tests, and what it still holds."""

from __future__ import annotations

import os
import signal
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from patience import HANG

if TYPE_CHECKING:
    from collections.abc import Iterator

# Nothing is to be written to the home directory, and nobody to be told.
os.environ.update(RAY_AUTH_MODE="disabled", RAY_USAGE_STATS_ENABLED="0", RAY_DEDUP_LOGS="0")
# A busy machine takes its time to start the head of a cluster, too.
os.environ.update(RAY_gcs_server_port_wait_time_s=f"{HANG:.0f}")

OBJECT_STORE_BYTES = 80 * 2**20


@contextmanager
def cluster(num_cpus: int) -> Iterator[Any]:
    """A cluster whose head has `num_cpus` to give, and this process connected to it."""
    import ray
    from ray.cluster_utils import Cluster

    settings: dict[str, Any] = {"num_cpus": num_cpus, "include_dashboard": False}
    made = Cluster()
    at_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        _added(made, **settings)
        ray.init(address=made.address, log_to_driver=False)
        # Ray has made it an exception: one test would fail of it, and all others go on, each
        # waiting for a cluster that may have got the signal as well.
        signal.signal(signal.SIGTERM, at_sigterm)
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def add_node(made: Any, num_cpus: int, **resources: float) -> Any:
    """One more node."""
    return _added(made, num_cpus=num_cpus, resources=resources)


def _added(made: Any, **settings: Any) -> Any:
    """A node that the cluster knows of, however long that takes."""
    node = made.add_node(wait=False, object_store_memory=OBJECT_STORE_BYTES, **settings)
    made._wait_for_node(node, timeout=HANG)
    return node


def living_actors() -> list[str]:
    """Actors that have not ended, by id."""
    from ray._private.state import actors

    return [id_ for id_, actor in actors().items() if actor["State"] != "DEAD"]


def no_actor_left() -> None:
    """Returns when all actors have ended; the cluster hears of each a moment later."""
    until = time.monotonic() + HANG
    while left := living_actors():
        assert time.monotonic() < until, f"left behind: {left}"
        time.sleep(0.02)


def dead_nodes_missed(made: Any) -> None:
    """Returns when the cluster has missed all nodes that are gone, and places nothing there."""
    import ray

    until = time.monotonic() + HANG
    while sum(node["Alive"] for node in ray.nodes()) > 1 + len(made.worker_nodes):
        assert time.monotonic() < until, "a node that is gone is still counted"
        time.sleep(0.1)
