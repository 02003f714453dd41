"""`Waiting`: how the calls of a group wait, side by side, for what hosts report.

Each call is a procedure that takes turns here until its replies are there. They are woken as
early as the least patient of them asks for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.group.wait import TURN, Procedure, Wait, earliest

if TYPE_CHECKING:
    from rlightning_aio.group.intake import Intake
    from rlightning_aio.group.poller import Poller
    from rlightning_aio.group.requests import Requests, Ticket
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.hosts.base import Watcher

__all__ = ["Waiting"]


class Waiting:
    """See the module; its arguments are the group's parts."""

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
        # How many results each call that waits wants.
        self._wanted: list[int] = []

    def poll(self) -> None:
        """Take in what hosts have ready."""
        self._poller.poll()
        self._drain()

    def _drain(self) -> None:
        """Have what hosts have told take effect.

        Invariant: a call that waits looks again, and arms the bell anew, after every reply that
        is taken in; here another call takes it.
        """
        self._intake.drain()
        if self._requests.answered:
            self._requests.answered = False
            self.wake()

    def wake(self) -> None:
        """Have calls that wait look again: they have not asked these envs' workers to wake them,
        or the goal of all of them has changed.
        """
        if self._wanted:
            self._watcher.wake()

    def check_liveness(self, now: float) -> Procedure[float]:
        """Look at all hosts now and then: a caller that always finds enough ready never has to
        wait, and would never hear of the dead and the hung.
        """
        if self._supervisor.is_overdue(now):
            now = yield Wait(0.0)
            self.check(now)
        return now

    def check(self, now: float) -> None:
        """Look at all hosts."""
        self._intake.now = now
        if self._supervisor.timed:
            self.poll()  # What is done is not hung.
        self._supervisor.check(now)
        self._drain()

    def turn(self, wanted: int, until: float | None) -> Procedure[float]:
        """One turn of waiting for `wanted` more replies; the time after it."""
        self._wanted.append(wanted)
        try:
            # The other calls that wait must be woken as early as they asked for.
            poller, first = self._poller, min(self._wanted)
            if poller.execute(wanted, until):
                return (yield from self.check_liveness((yield Wait(0.0))))
            if poller.spin(first):
                return (yield from self.check_liveness((yield TURN)))
            poller.arm(first)
            until = earliest(until, self._supervisor.next_check())
            if poller.came():
                return (yield from self.check_liveness((yield TURN)))
            now = yield Wait(until)
            poller.slept()
        finally:
            self._wanted.remove(wanted)
        self.check(now)
        return now

    def end(self) -> None:
        """A call waits no more."""
        if not self._wanted:
            self._poller.disarm()

    def until_replied(self, ticket: Ticket) -> Procedure[None]:
        """Until all replies of `ticket` are there. Given up, they go to `collect_async`."""
        try:
            if self._supervisor.has_members:
                self.poll()  # What clients have sent already may wake nobody any more.
            while ticket.remaining > 0:
                yield from self.turn(ticket.remaining, None)
                self.poll()
        except BaseException:
            self._requests.give_up(ticket)
            self.wake()
            raise
        finally:
            self.end()
        self._requests.settle(ticket)
