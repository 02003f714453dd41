"""`Poller`: how the trainer comes by results, with as few wake-ups as can be.

It looks for them itself for a moment, arms the bell of the workers, takes in what came
without one, and has inline hosts execute what is asked of them. The wait for a number of
results ends when that many are there, however long the other envs take: see `arm`.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from rlightning_aio.hosts.base import Executing, Membership, Polled
from rlightning_aio.hosts.spinner import Spinner

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.group.requests import Requests
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.protocol.bell import TrainerBell

__all__ = ["Poller"]


class Poller:
    """Over the hosts of one group.

    Args:
        requests: tells what is in flight where.
        bell: the workers'.
        num_cores: cores that this process and its workers may use.
        clock: monotonic seconds; asked only between the envs of inline hosts.
    """

    def __init__(
        self,
        requests: Requests,
        bell: TrainerBell,
        num_cores: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.num_cores = num_cores
        self._requests = requests
        self._bell = bell
        self._clock = clock
        self._workers: dict[int, Polled] = {}
        self._env_servers: dict[int, Membership] = {}
        self._executing: deque[tuple[int, Executing]] = deque()
        self._spinner = Spinner(enabled=True)
        self._spun = False

    def add(self, host: Host) -> None:
        """Take in a host of the group."""
        if isinstance(host, Executing):
            self._executing.append((host.host_id, host))
        elif isinstance(host, Membership):
            self._env_servers[host.host_id] = host
        elif isinstance(host, Polled):
            self._workers[host.host_id] = host

    # -- taking in --------------------------------------------------------------------

    def poll(self) -> None:
        """Take in results that wake nobody."""
        workers = self._workers
        for host_id in self._bell.with_news() if workers else ():
            workers[host_id].poll()
        for host_id, server in self._env_servers.items():
            if self._requests.in_flight[host_id]:
                server.poll()

    def execute(self, wanted: int, until: float | None) -> bool:
        """Have inline hosts execute what waits: one request, or as many as nobody else can give.

        Args:
            wanted: results; no more are executed.
            until: when to stop, between two envs.

        Returns whether any did.
        """
        if not self._executing:
            return False
        in_flight = self._requests.in_flight
        waiting = sum([in_flight[host_id] for host_id, _ in self._executing])
        if not waiting:
            return False
        if self._requests.total_in_flight() > waiting:
            wanted = 1
        for count in range(wanted):
            late = count and until is not None and self._clock() >= until
            if late or not self._execute_next():
                break
        for _, host in self._executing:
            host.poll()
        return True

    def _execute_next(self) -> bool:
        """One request of the next inline host in turn, so that none waits for ever."""
        for _ in range(len(self._executing)):
            _, host = self._executing[0]
            self._executing.rotate(-1)
            if host.execute_next():
                return True
        return False

    # -- waiting for workers ----------------------------------------------------------

    def spin(self, wanted: int) -> bool:
        """Whether `wanted` results have come within a moment of looking for them.

        Tried only while there are more cores than workers at work: theirs come first. So do
        those of clients, which may be processes of this machine, too.
        """
        in_flight = self._requests.in_flight
        at_work = 0
        for host_id in self._workers:
            if in_flight[host_id]:
                at_work += 1
        servers: list[Membership] = []
        for host_id, server in self._env_servers.items():
            if in_flight[host_id]:
                at_work += in_flight[host_id]
                servers.append(server)
        self._spun = 0 < at_work < self.num_cores
        if not self._spun:
            return False
        self._bell.disarm()
        unread = self._bell.unread
        if not servers:
            return self._spinner.spin(lambda: unread() >= wanted)
        return self._spinner.spin(
            lambda: unread() >= wanted or any(server.is_readable() for server in servers)
        )

    def slept(self) -> None:
        """A wait that was no spin is over."""
        if self._spun:
            self._spinner.slept()

    def arm(self, wanted: int) -> None:
        """Have the workers wake us when `wanted` results are ready, or all that they owe.

        Args:
            wanted: by the call that wants the fewest.
        """
        in_flight = self._requests.in_flight
        total = sum([in_flight[host_id] for host_id in self._workers])
        if total:
            wanted = min(wanted, total)
            self._bell.arm(self._bell.goal(wanted), at_last=wanted == total)
        else:
            self._bell.disarm()

    def came(self) -> bool:
        """Whether they are ready already; to be asked last before the trainer sleeps."""
        return self._bell.reached()

    def disarm(self) -> None:
        """Nobody waits any more."""
        self._bell.disarm()
