"""`Lookout`: how the trainer comes by results, with as few wake-ups as can be.

It looks for them itself for a moment, orders bells of workers, takes in what came
without one, and executes what is asked of inline envs.
"""

from __future__ import annotations

from collections import deque
from math import ceil
from typing import TYPE_CHECKING

from rlightning_aio.hosts.spinner import Spinner

if TYPE_CHECKING:
    from rlightning_aio.hosts.base import Host

__all__ = ["Lookout"]

_WAKE_UP_NS = 160_000
"""What it costs to wake the trainer, about: what it needs itself, and what the worker whose
core it takes needs to get back into its stride."""


class Lookout:
    """Over the hosts of one group.

    Args:
        hosts: grows as hosts are added to the group.

    Attributes:
        num_cores: cores that this process and its workers may use.
    """

    def __init__(self, hosts: list[Host]) -> None:
        self.num_cores = 0
        self._hosts = hosts
        # What a step takes there lately, about; until anything is known, as long as waking us.
        self._step_ns: dict[Host, float] = {}
        self._inline: deque[Host] = deque()
        self._spinner = Spinner(enabled=True)
        self._spun = False
        self._last: Host | None = None

    def add_inline(self, host: Host) -> None:
        """Let an inline host have its turns."""
        self._inline.append(host)

    def spin(self, wanted: int) -> bool:
        """Whether `wanted` results have come within a moment of looking for them.

        Tried only while there are more cores than workers at work: theirs come first. So do
        those of clients, which may be processes of this machine, too.
        """
        busy = [host for host in self._hosts if host.in_flight]
        at_work = sum([host.in_flight if host.elastic else 1 for host in busy])
        self._spun = 0 < at_work < self.num_cores
        if not self._spun:
            return False
        for host in busy:
            host.withdraw()
        return self._spinner.spin(lambda: sum(host.unread() for host in busy) >= wanted)

    def slept(self) -> None:
        """A wait that was no spin is over."""
        if self._spun:
            self._spinner.slept()

    def order(self, wanted: int) -> bool:
        """Ask hosts to wake us when `wanted` results may be ready; True if some are already.

        Where all results are wanted, one host is asked for all of its own: that which was the
        last to be done before. Else each of H busy hosts is asked for the H-th part, rounded
        up: when `wanted` results are ready in all, at least one host has its part, so nobody
        wakes us too late. Where steps take less than waking us up, each is asked for as many
        more as it does meanwhile, but kept busy: then one wake-up does, and brings more.
        """
        busy = [host for host in self._hosts if host.in_flight]
        if wanted >= sum([host.in_flight for host in busy]):
            return self._order_of_last(busy)
        part = ceil(wanted / len(busy)) if busy else 0
        came = False
        for host in busy:
            left = max(host.in_flight - part, 0)
            more = min(self._steps_per_wake_up(host), left // 2) if wanted > 1 else 0
            came = host.order(min(part, host.in_flight) + more) or came
        return came

    def _steps_per_wake_up(self, host: Host) -> int:
        return int(_WAKE_UP_NS / max(self._step_ns.get(host, _WAKE_UP_NS), 1.0))

    def note_step(self, host: Host, ns: float) -> None:
        """Take note of what a step has taken."""
        before = self._step_ns.get(host, _WAKE_UP_NS)
        self._step_ns[host] = before + 0.2 * (ns - before)

    def _order_of_last(self, busy: list[Host]) -> bool:
        if self._last not in busy:
            self._last = busy[-1] if busy else None
        came = False
        for host in busy:
            if host is self._last:
                came = host.order(host.in_flight)
            else:
                host.withdraw()
        return came

    def sweep(self) -> None:
        """Take in results that came without a bell."""
        for host in self._hosts:
            # A host that was asked for a single result has rung if it has any.
            if host.in_flight and host.ordered != 1:
                host.sweep()

    def run_inline(self, wanted: int) -> bool:
        """Execute waiting requests of inline hosts, one, or as many as nothing else can give."""
        waiting = sum([host.in_flight for host in self._inline])
        if not waiting:
            return False
        if sum([host.in_flight for host in self._hosts]) > waiting:
            wanted = 1
        for _ in range(wanted):
            if not self._run_next_inline():
                break
        return True

    def _run_next_inline(self) -> bool:
        """One request of the next inline host in turn, so that none waits for ever."""
        for _ in range(len(self._inline)):
            host = self._inline[0]
            self._inline.rotate(-1)
            if host.run_one():
                return True
        return False
