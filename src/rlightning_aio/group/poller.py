"""`Poller`: how the trainer comes by results, with as few wake-ups as can be.

It looks for them itself for a moment, arms the bell of the workers, takes in what came
without one, and has inline hosts execute what is asked of them. The wait for a number of
results ends when that many are there, however long the other envs take: see `arm`.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Final

from rlightning_aio.hosts.base import Executing, Membership, Polled
from rlightning_aio.hosts.spinner import Spinner

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.group.requests import Requests
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.protocol.bell import TrainerBell

__all__ = ["Poller"]

_WAKE_UP_NS: Final = 160_000
"""What it costs to wake the trainer, about: what it needs itself, and what the worker whose
core it takes needs to get back into its stride."""
_LOOK_AGAIN_SECONDS: Final = 0.0006
"""How long after it has armed the bell anew the trainer looks once by itself; drivers make it
up to twice as long. No result that was waited for is later than that."""
_LONGEST_PACE: Final = 256


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
        # What a step takes there lately, about; until anything is known, as long as waking us.
        self._step_ns: dict[int, float] = {}
        self._spinner = Spinner(enabled=True)
        self._spun = False
        # What is being waited for.
        self._goal = -1

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

    def arm(self, wanted: int, now: float) -> tuple[bool, float | None]:
        """Have the workers wake us when `wanted` results are ready.

        Where steps are short, a few more are asked for at first: they are there before the
        trainer would be, one wake-up brings them along, and workers lose their stride less
        often. Some half a millisecond later the trainer looks by itself, and asks for no more than
        it needs from then on; so a wait that is longer loses nothing by it. That look also finds
        what came in the very moment of arming (see `protocol.bell`).

        Args:
            wanted: by the call that wants the fewest.
            now: monotonic seconds.

        Returns:
            Whether they are there already, and when to look without being woken (None: not
            before a bell).
        """
        in_flight = self._requests.in_flight
        busy = [host_id for host_id in self._workers if in_flight[host_id]]
        total = sum([in_flight[host_id] for host_id in busy])
        if not total:
            return False, None
        wanted = min(wanted, total)
        goal = self._bell.goal(wanted)
        if wanted == total:
            # Each of them looks when it has nothing left to do, and the last of all rings.
            self._bell.arm(goal, _LONGEST_PACE)
            return self._bell.unread() >= wanted, None
        first, self._goal = goal != self._goal, goal
        more = self._steps_meanwhile(busy, wanted, total) if first else 0
        is_new = self._bell.arm(goal + more, 1)
        return self._bell.unread() >= wanted, now + _LOOK_AGAIN_SECONDS if is_new else None

    def disarm(self) -> None:
        """Nobody waits any more."""
        self._bell.disarm()
        self._goal = -1

    def _steps_meanwhile(self, busy: list[int], wanted: int, total: int) -> int:
        """Results that come while the trainer is being woken, and leave workers enough to do."""
        if wanted == 1:
            return 0
        in_flight = self._requests.in_flight
        spare = (total - wanted) / 2 / total
        return sum(
            [
                min(int(_WAKE_UP_NS / max(self._step_ns.get(k, _WAKE_UP_NS), 1.0)),
                    int(in_flight[k] * spare))
                for k in busy
            ]
        )  # fmt: skip

    def note_step(self, host_id: int, ns: float) -> None:
        """Take note of what a step has taken."""
        before = self._step_ns.get(host_id, _WAKE_UP_NS)
        self._step_ns[host_id] = before + 0.2 * (ns - before)
