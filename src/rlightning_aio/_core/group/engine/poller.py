"""`Poller`: gets results from hosts with as few wake-ups as possible.

It spins briefly for results, arms the bell of the workers, polls hosts that ring no bell, and runs
the requests of inline hosts. A wait for a number of results ends when that many are ready, however
long the other envs take: see `arm`.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from rlightning_aio._core.hosts.base import Executing, Membership, Polled, SharesThread
from rlightning_aio._core.hosts.spinner import Spinner

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio._core.hosts.base import Host
    from rlightning_aio.protocol.rings import TrainerBell

__all__ = ["Poller"]


class Poller:
    """Polls the hosts of one group.

    Args:
        requests: counts the requests in flight at each host.
        bell: of the workers.
        num_cores: cores that this process and its workers may use.
        clock: monotonic seconds; read only between the envs of inline hosts.
    """

    def __init__(
        self,
        requests: Requests,
        bell: TrainerBell,
        num_cores: int,
        clock: Callable[[], float],
    ) -> None:
        self.num_cores = num_cores
        self._requests = requests
        self._bell = bell
        self._clock = clock
        self._workers: dict[int, Polled] = {}
        self._on_loop: list[int] = []
        self._memberships: dict[int, Membership] = {}
        self._executing: deque[tuple[int, Executing]] = deque()
        self._spinner = Spinner(enabled=True)
        self._spun = False

    def add(self, host: Host) -> None:
        """Add a host of the group."""
        if isinstance(host, Executing):
            self._executing.append((host.host_id, host))
        elif isinstance(host, Membership):
            self._memberships[host.host_id] = host
        elif isinstance(host, Polled):
            self._workers[host.host_id] = host
        if isinstance(host, SharesThread):
            self._on_loop.append(host.host_id)

    # -- reading results --------------------------------------------------------------

    def poll(self) -> None:
        """Read results that are ready without a wake-up."""
        workers = self._workers
        for host_id in self._bell.with_news() if workers else ():
            workers[host_id].poll()
        for host_id, server in self._memberships.items():
            if self._requests.in_flight[host_id]:
                server.poll()

    def execute(self, wanted: int, until: float | None) -> bool:
        """Execute requests of inline hosts: one, or `wanted` if no other host has any in flight.

        Args:
            wanted: the largest number of requests to execute.
            until: monotonic seconds at which to stop, between two envs.

        Returns True if any request was executed.
        """
        if not self._executing:
            return False
        in_flight = self._requests.in_flight
        waiting = sum([in_flight[host_id] for host_id, _ in self._executing])
        if not waiting:
            return False
        if sum(self._requests.in_flight) > waiting:
            wanted = 1
        count = 0
        try:
            while count < wanted and self._execute_next():
                count += 1
                if until is not None and self._clock() >= until:
                    break
        finally:  # Ctrl-C may be raised in an env.
            for _, host in self._executing:
                host.poll()
        return count > 0

    def _execute_next(self) -> bool:
        """Execute one request of the next inline host, in turn so that none waits forever."""
        for _ in range(len(self._executing)):
            _, host = self._executing[0]
            self._executing.rotate(-1)
            if host.execute_next():
                return True
        return False

    # -- waiting for workers ----------------------------------------------------------

    def spin(self, wanted: int) -> bool:
        """Spin briefly for `wanted` results; True if they are ready.

        Spin only while there are more cores than busy workers and members (which may run on this
        machine), and while no env that shares this thread is busy, as it couldn't make progress.
        """
        in_flight = self._requests.in_flight
        self._spun = False
        if any(in_flight[host_id] for host_id in self._on_loop):
            return False
        num_busy = 0
        for host_id in self._workers:
            if in_flight[host_id]:
                num_busy += 1
        servers: list[Membership] = []
        for host_id, server in self._memberships.items():
            if in_flight[host_id]:
                num_busy += in_flight[host_id]
                servers.append(server)
        self._spun = 0 < num_busy < self.num_cores
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
        """Report to the spinner that a spin was followed by a sleep."""
        if self._spun:
            self._spinner.slept()

    def arm(self, wanted: int) -> None:
        """Have the workers wake this process when `wanted` results are ready, or all in flight.

        Args:
            wanted: the number that the call with the fewest waits for.
        """
        in_flight = self._requests.in_flight
        total = sum([in_flight[host_id] for host_id in self._workers])
        if total:
            wanted = min(wanted, total)
            self._bell.arm(self._bell.goal(wanted), at_last=wanted == total)
        else:
            self._bell.disarm()

    def is_reached(self) -> bool:
        """True if the armed number is ready; check this last before sleeping."""
        return self._bell.reached()

    def disarm(self) -> None:
        """Disarm the bell, as no call waits."""
        self._bell.disarm()
