"""`Waiting`: lets concurrent calls of a group wait for replies.

Each call is a procedure that takes turns here until its replies are ready. The bell is armed for
the call that waits for the fewest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio._core.group.drivers.wait import TURN, Procedure, Wait

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.intake import Intake
    from rlightning_aio._core.group.engine.poller import Poller
    from rlightning_aio._core.group.state.requests import Requests, Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.hosts.base import Watcher

__all__ = ["Waiting"]


class Waiting:
    """The waiting calls of a group.

    Attributes:
        wanted: the number of results that each call waits for.
    """

    def __init__(
        self,
        requests: Requests,
        supervisor: Supervisor,
        poller: Poller,
        intake: Intake,
        watcher: Watcher,
    ) -> None:
        self._requests = requests
        self._supervisor = supervisor
        self._poller = poller
        self._intake = intake
        self._watcher = watcher
        self.wanted: list[int] = []

    def poll(self) -> None:
        """Read and apply the replies that are ready."""
        self._poller.poll()
        self._drain()

    def _drain(self) -> None:
        """Apply queued completions.

        Invariant: a waiting call checks its replies and arms the bell again after every reply that
        is applied, also if another call applies it here.
        """
        self._intake.drain()
        if self._requests.has_news:
            self._requests.has_news = False
            self.wake()

    def wake(self) -> None:
        """Wake all waiting calls, to check their replies and arm the bell again.

        Needed after requests that the armed bell doesn't count, and when the number to arm changes.
        """
        if self.wanted:
            self._watcher.wake()

    def check_liveness(self, now: float) -> Procedure[float]:
        """Check all hosts from time to time; return the time.

        A caller that always finds enough results ready never waits, so it would miss dead and hung
        workers otherwise.
        """
        if now >= self._supervisor.look_by:
            now = yield Wait(0.0)
            self.check(now)
        return now

    def check(self, now: float) -> None:
        """Check all hosts for deaths and hangs, and apply the outcome."""
        self._intake.now = now
        if self._supervisor.detector.timed:
            self.poll()  # An env that has replied is not hung.
        self._supervisor.check(now)
        self._drain()

    def turn(self, wanted: int, until: float | None) -> Procedure[float]:
        """Wait once for `wanted` more replies, and return the time after it; the caller loops."""
        self.wanted.append(wanted)
        try:
            # Other calls may wait for fewer results.
            poller, first = self._poller, min(self.wanted)
            if poller.execute(wanted, until):
                return (yield from self.check_liveness((yield Wait(0.0))))
            if poller.spin(first):
                return (yield from self.check_liveness((yield TURN)))
            poller.arm(first)
            until = self._supervisor.next_check(until)
            if poller.is_reached():
                return (yield from self.check_liveness((yield TURN)))
            now = yield Wait(until)
            poller.slept()
        finally:
            self.wanted.remove(wanted)
        self.check(now)
        return now

    def end(self) -> None:
        """Disarm the bell if no call waits now."""
        if not self.wanted:
            self._poller.disarm()

    def ask(
        self,
        now: float,
        slots: NDArray[np.intp],
        send: Callable[[Ticket], object],
        method: str = "",
    ) -> Procedure[tuple[Ticket, float]]:
        """Send requests, and wait for all replies; return them in their ticket, and the time.

        After an error or cancellation, `collect_async` gets what `give_up` leaves to it.

        Args:
            now: monotonic seconds.
            slots: whose requests.
            send: submits all of them for the ticket that it gets, or raises before the first.
            method: see `Tickets.open`.
        """
        ticket = self.begin(slots, send, method)
        try:
            if self._supervisor.members.possible:
                self.poll()  # Replies of members that were read before cause no wake-up.
            now = yield from self.until_replied(ticket, now)
        except BaseException:
            self.give_up(ticket)
            raise
        finally:
            self.end()
        self._requests.settle(ticket)
        return ticket, now

    def begin(
        self, slots: NDArray[np.intp], send: Callable[[Ticket], object], method: str = ""
    ) -> Ticket:
        """Send requests, as `ask` does, and return their ticket."""
        ticket = self._requests.tickets.open(slots, method=method)
        try:
            send(ticket)
        except BaseException:
            self.give_up(ticket)
            raise
        return ticket

    def give_up(self, ticket: Ticket) -> None:
        """Close a ticket that nobody waits for any more."""
        self._requests.give_up(ticket)
        self.wake()

    def until_replied(self, ticket: Ticket, now: float) -> Procedure[float]:
        """Wait for all replies of `ticket`; return the time after that."""
        while ticket.remaining > 0:
            now = yield from self.turn(ticket.remaining, None)
            self.poll()
        return now
