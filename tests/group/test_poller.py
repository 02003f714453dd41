"""How the poller waits for results: what it orders, and when it spins."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio._core.group.engine.waiting import Poller
from rlightning_aio._core.group.state.request_states import COLLECTOR
from rlightning_aio._core.group.state.requests import Requests
from rlightning_aio._core.hosts.base import Host
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.rings import TrainerBell, WorkerBell, bell_size


@dataclass(eq=False)
class Worker(Host):
    """The part of a process host that a poller uses."""

    host_id: int
    on_bell = True


class Server(Worker):
    """The part of an env_server that a poller uses."""

    on_bell = False
    env_id, client = "server-0/0", "here"
    first_slot = num_envs = 0

    def __init__(self, host_id: int) -> None:
        super().__init__(host_id)
        self.readable = False
        self.looked_at = 0
        self.server: Any = self  # Of this place alone.

    def is_readable(self) -> bool:
        self.looked_at += 1
        return self.readable

    def _not_asked(self, *args: Any) -> Any:
        raise AssertionError

    start = attach = packed = submit = close = release = _not_asked
    check_step = check_reset = admit = drop_reset = _not_asked


class Scene:
    """A poller over hosts with given numbers of requests in flight, and a visible bell."""

    def __init__(self, *in_flight: int, kinds: Any = Worker, num_cores: int = 0) -> None:
        count = len(in_flight)
        memory = memoryview(bytearray(bell_size(count)))
        self.bell = TrainerBell(memory, count)
        self.workers = [WorkerBell(memory, count, k) for k in range(count)]
        self.counts = [0] * count
        self.requests = Requests(np.repeat(np.arange(count), in_flight), count)
        self.requests.issue(np.arange(sum(in_flight)), Operation.STEP, COLLECTOR, 0.0)
        self.requests.in_flight[:] = in_flight
        self.orders: list[tuple[int, bool]] = []
        arm = self.bell.arm

        def noted(goal: int, *, at_last: bool) -> bool:
            self.orders.append((goal - self.bell.goal(0), at_last))
            return arm(goal, at_last=at_last)

        self.bell.arm = noted  # type: ignore[method-assign]
        self.poller = Poller(self.requests, self.bell, num_cores, clock=time.monotonic)
        kinds = kinds if isinstance(kinds, tuple) else (kinds,) * count
        self.hosts: list[Any] = [kind(k) for k, kind in enumerate(kinds)]
        for host in self.hosts:
            self.poller.add(host)

    def report(self, host_id: int, count: int = 1) -> None:
        self.counts[host_id] += count
        self.workers[host_id].publish(self.counts[host_id])

    def take(self) -> None:
        """Read all reports, as the trainer does."""
        for host_id in self.bell.with_news():
            count = self.bell.counters[host_id] - self.bell.read[host_id]
            self.bell.took(host_id, count)
            self.requests.in_flight[host_id] -= count

    def arm(self, wanted: int) -> bool:
        return self.poller.arm(wanted)


# -- orders


@given(
    in_flight=st.lists(st.integers(1, 64), min_size=1, max_size=8),
    wanted=st.integers(1, 512),
    data=st.data(),
)
def test_the_last_wanted_result_rings_the_bell(
    in_flight: list[int], wanted: int, data: st.DataObject
) -> None:
    """From any worker, and at most as many as are in flight."""
    scene = Scene(*in_flight)
    total = sum(in_flight)
    least = min(wanted, total)
    assert not scene.arm(wanted)
    assert scene.orders == [(least, least == total)]
    rung = 0
    order = [k for k, count in enumerate(in_flight) for _ in range(count)]
    left = list(in_flight)
    for number, host_id in enumerate(data.draw(st.permutations(order)), 1):
        scene.counts[host_id] += 1
        left[host_id] -= 1
        worker = scene.workers[host_id]
        if worker.publish(scene.counts[host_id]) or not left[host_id]:
            rung += worker.is_due()
        assert (rung > 0) == (number >= least)


def test_the_bell_is_not_armed_if_all_workers_are_idle() -> None:
    """Clients wake the trainer by themselves, and inline envs are executed by the poller."""
    scene = Scene(0, 3, kinds=(Worker, Server))
    assert not scene.arm(2)
    assert scene.orders == []


# -- reading


def test_clients_on_this_machine_are_left_the_cores() -> None:
    """One core for each client that owes a result."""
    scene = Scene(2, kinds=Server, num_cores=2)
    (server,) = scene.hosts
    server.readable = True
    assert not scene.poller.spin(1)
    assert not server.looked_at
    scene.requests.in_flight[0] = 1
    assert scene.poller.spin(1)
    assert server.looked_at


def test_workers_are_left_the_cores() -> None:
    """One for each worker with requests; the trainer spins only on a core of its own."""
    scene = Scene(8, 8, num_cores=2)
    scene.report(0, 8)
    assert not scene.poller.spin(1)
    scene.take()
    scene.report(1)
    assert scene.poller.spin(1)


def test_a_spinning_trainer_disarms_the_bell() -> None:
    """It finds the results itself."""
    scene = Scene(2, num_cores=2)
    scene.arm(2)
    scene.report(0, 2)
    assert scene.poller.spin(2)
    assert not scene.workers[0].is_due()
