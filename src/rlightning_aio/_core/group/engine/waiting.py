"""`Waiting`: lets concurrent calls of a group wait for replies; and `Poller`, which finds them.

Each call is a procedure that takes turns here until its replies are ready. The bell of the workers
is armed for the call that waits for the fewest results, however long the other envs take. What is
read wakes all of them, so many envs that are asked one by one share one call (see `AgentSteps`).
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio._core.group.drivers.wait import TURN, Procedure, Wait, earliest
from rlightning_aio._core.group.state.conditions import OF_HOSTS
from rlightning_aio._core.group.state.request_states import COLLECTOR, NOBODY, State
from rlightning_aio._core.group.supervision.supervisor import LOOK_SECONDS
from rlightning_aio._core.hosts.base import Executing, SelfStarting
from rlightning_aio._core.hosts.spinner import Spinner
from rlightning_aio.errors import EnvBusy

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.intake import Intake
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.state.requests import Requests, Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.base import Host, Server
    from rlightning_aio.protocol.rings import TrainerBell

REPLIES: Final = Wait()
"""What `Waiting.serve` waits for where its work has nothing else to wait for."""


class Waiting:
    """The waiting calls of a group.

    Args:
        tables, supervisor, poller: of the group.
        intake: applies what the poller finds.

    Attributes:
        wanted: the numbers of results that calls wait for, and how many calls for each.
        collecting: when the call began that waits for the collector's results; 0.0 if none does.
        intake: as given.
    """

    def __init__(
        self, tables: Tables, supervisor: Supervisor, poller: Poller, intake: Intake
    ) -> None:
        self._envs = tables.envs
        self._requests = tables.requests
        self._lifetime = tables.lifetime
        self._conditions = tables.conditions
        self._supervisor = supervisor
        self._poller = poller
        self._bell = poller.bell
        self.intake = intake
        self._completions = tables.completions
        self._driver = tables.driver
        # If True, each request to an inline env is executed in a turn of its own.
        self._shares_thread = tables.shares_thread
        # Of the call of `serve`, while there is one.
        self._served: Ticket | None = None
        self._steps: Mapping[int, object] = {}
        self.wanted: dict[int, int] = {}
        self.collecting = 0.0
        # By call, since when it waits for empty places alone.
        self._alone_since: dict[tuple[int, int], float] = {}

    def poll(self) -> None:
        """Read and apply the replies that are ready.

        Invariant: a waiting call checks its replies and arms the bell again after every reply that
        is applied, also if another call applies it here.
        """
        if self._completions:
            self.intake.apply_completions()
        requests, bell = self._requests, self._bell
        if self._conditions.unusual or (
            bell.counters != bell.read_by_worker and not requests.read(bell)
        ):
            self._poller.poll()
            self.intake.apply_completions()
        if requests.anything_ended:
            requests.anything_ended = False
            if self.wanted:
                self.wake()

    def wake(self) -> None:
        """Wake waiting calls, to check their replies and arm the bell again: see the module.

        Needed after requests that the armed bell doesn't count, and when the number to arm changes.
        """
        if self.wanted or self._served is not None:
            self._driver.wake()

    def check_now(self) -> Procedure[float]:
        """Check all hosts; return the time. It must be called by `Supervisor.look_by`.

        A caller that always finds enough results ready never waits, so it would miss dead and hung
        workers otherwise.
        """
        now = yield Wait(0.0)
        self.check(now)
        return now

    def check(self, now: float) -> None:
        """Check all hosts for deaths and hangs, and apply the outcome."""
        if now >= self._supervisor.due:
            self.poll()  # An env that has replied is not hung, and owes nothing.
        self._supervisor.check(now)
        self.poll()

    def check_sendable(self, now: float, slots: NDArray[np.intp], what: str) -> None:
        """Apply completions; raise an error if the group is closed, or a slot is busy or gone.

        A request that was cancelled or aborted may keep an env busy. So what has ended by now is
        applied first, and in this process such a request is executed.
        """
        self._lifetime.check_open()
        self.intake.apply_completions()
        while (slot := self._requests.first_not_idle(slots)) is not None:
            if self._requests.owner[slot] != NOBODY or not self._end_call(now, slot):
                break
        if slot is not None:
            raise EnvBusy(
                f"can't {what} {self._envs.describe(slot)}: {self._why_busy(slot)}; nothing was "
                "sent"
            )
        # Last: the error of a worker that is gone may still have to be collected.
        self._supervisor.losses.check(slots)

    def _why_busy(self, slot: int) -> str:
        state, owner = self._requests.state.item(slot), self._requests.owner.item(slot)
        if owner == NOBODY:
            return "what was cancelled or aborted still runs in it; try again when that has ended"
        why = {
            State.BUSY: "its last request has not replied yet",
            State.READY: "the result of its last request was not collected",
            State.SPENT: "its last request ended in an error that was not collected",
        }[State(state)]
        if owner == COLLECTOR:
            others = self._driver.others(self._requests.collector)
            return f"{why}{others}; collect it first, with collect_async(), or end it with drain()"
        if state != State.BUSY:
            why = "the call that asked it has not returned yet"
        ticket = self._requests.tickets.waiting[owner]
        held = self._steps.get(slot, ticket) if ticket is self._served else ticket
        return f"{why}{self._driver.others(held)}; wait for that call first"

    def _end_call(self, now: float, slot: int) -> bool:
        """Note the end of a request of nobody that has ended since the group last waited.

        In this process, it is executed now, after the requests that were sent before it. Returns
        False if it has not ended.
        """
        self._driver.read()
        self.intake.apply_completions()
        while not self._requests.is_idle(slot) and self._poller.execute(1, None):
            self.intake.apply_completions()
        if not self._requests.is_idle(slot):  # Perhaps nobody waits who would replace its worker.
            self.check(now)
        return self._requests.is_idle(slot)

    def turn(self, wanted: int, until: float | None) -> Procedure[float]:
        """Wait once for `wanted` more replies, and return the time after it; the caller loops.

        Requests to inline envs are executed in that time.
        """
        poller, supervisor, in_flight = self._poller, self._supervisor, self._requests.in_flight
        if supervisor.places.num_held or self._alone_since:
            until = earliest(until, self._look_at_places())
        self.wanted[wanted] = self.wanted.get(wanted, 0) + 1
        try:
            if poller.inline and poller.execute(1 if self._shares_thread else wanted, until):
                now = yield TURN if len(poller.inline) == len(in_flight) else Wait(0.0)
                is_due = now >= supervisor.look_by
            else:
                # Other calls may wait for fewer results.
                first = min(self.wanted)
                # A quick look; `spin` decides.
                may_spin = len(in_flight) - in_flight.count(0) < poller.num_cores
                if (may_spin and poller.spin(first)) or poller.arm(first):
                    now = yield TURN
                    is_due = now >= supervisor.look_by
                    if is_due:
                        now = yield Wait(0.0)
                else:
                    is_due = until is not None or supervisor.detector.any_ending
                    is_due = is_due or self._conditions.unusual & OF_HOSTS != 0
                    patient = supervisor.patient
                    now = yield Wait(supervisor.next_check(until)) if is_due else patient
                    if may_spin:
                        poller.slept()
                    if not is_due:
                        supervisor.look_by = now + LOOK_SECONDS
                        is_due = self._conditions.unusual & OF_HOSTS != 0
        finally:
            if (calls := self.wanted.pop(wanted)) > 1:
                self.wanted[wanted] = calls - 1
            elif not self.wanted:
                self._bell.disarm()
        if is_due or now >= supervisor.due:
            self.check(now)
        return now

    def _look_at_places(self) -> float | None:
        """End the requests of calls that have waited for clients alone for too long.

        Returns when to look again; that is now, if a call has learned something.
        """
        now, due = self._supervisor.clock(), None
        before, self._alone_since = self._alone_since, {}
        for owner, records in self._supervisor.places.held().items():
            for call, own in self._alone(owner, records):
                since = before.get(call, now)
                if owner == COLLECTOR:
                    since = max(since, self.collecting)
                self._alone_since[call] = since
                late, next_end = self._supervisor.places.late(own, since, now)
                if late:  # What is left for the collector may wait on.
                    self.intake.end_held(late if owner == COLLECTOR else own)
                    due = now
                due = earliest(due, next_end)
        return due

    def _alone(
        self, owner: int, records: Sequence[HostRecord]
    ) -> list[tuple[tuple[int, int], Sequence[HostRecord]]]:
        """Return the calls of an owner that wait for nothing but held requests, by a key."""
        if owner > 0:
            ticket = self._requests.tickets.waiting[owner]
            if ticket.apart:  # Each request is a call of its own.
                return [((owner, record.slots.start), [record]) for record in records]
            num_left = ticket.remaining
        else:
            num_left = self._requests.collector.num_awaited if self.collecting else -1
        return [((owner, -1), records)] if num_left == len(records) else []

    def until(
        self, now: float, num_left: Callable[[], int], end: float | None = None
    ) -> Procedure[float]:
        """Wait until `num_left` replies are 0, or until `end`; return the time."""
        self.poll()
        while (wanted := num_left()) and (end is None or now < end):
            now = yield from self.turn(wanted, end)
            self.poll()
        return now

    def ask(
        self, now: float, slots: NDArray[np.intp], send: Callable[[Ticket], object]
    ) -> Procedure[tuple[Ticket, float]]:
        """Send requests, and wait for all replies; return them in their ticket, and the time.

        After an error or cancellation, `collect_async` gets what `Requests.leave` leaves to it.

        Args:
            now: monotonic seconds.
            slots: whose requests.
            send: sends all of them for the ticket that it gets, or raises before the first.
        """
        ticket = self._requests.tickets.open(slots)
        try:
            send(ticket)
            if self._completions:  # A client is gone, say, or no worker can be started.
                self.poll()
            while ticket.remaining > 0:
                now = yield from self.turn(ticket.remaining, None)
                self.poll()
        except BaseException:
            self._leave(ticket)
            raise
        self._requests.close(ticket)
        return ticket, now

    def serve(
        self,
        now: float,
        work: Callable[[Ticket, float], Wait | None],
        steps: Mapping[int, object],
    ) -> Procedure[None]:
        """Do some work again and again, whenever replies to its requests are ready.

        After an error, it is as with `ask`.

        Args:
            now: monotonic seconds.
            work: takes the replies that its ticket has, sends more requests for it, and returns
                what to wait for, `REPLIES` or a wait; None at the end. Gets the ticket and the
                time.
            steps: by slot, what whoever waits for its request holds.
        """
        self._steps = steps
        self._served = ticket = self._requests.tickets.open(np.zeros(0, np.intp), apart=True)
        try:
            while (wait := work(ticket, now)) is not None:
                if wait is REPLIES:
                    now = yield from self.turn(1, None)
                else:
                    now = yield wait
                    if now >= self._supervisor.look_by:
                        self.check(now)
                self.poll()
        except BaseException:
            self._leave(ticket)
            raise
        finally:
            self._served = None
        self._requests.close(ticket)

    def leave(self, slot: int) -> None:
        """Leave one request of the call of `serve`, whose caller was cancelled."""
        if self._served is not None:
            self._leave(self._requests.split(self._served, slot))

    def _leave(self, ticket: Ticket) -> None:
        """Close a ticket whose call no longer waits; what is held for clients is never sent."""
        if self._supervisor.places.num_held:
            self._supervisor.places.drop_of(ticket.owner)
        self._requests.leave(ticket)
        self.wake()


class Poller:
    """Gets results from the hosts of one group with as few wake-ups as possible.

    It reads what hosts have ready, spins briefly for more, arms the bell of the workers, and
    executes the requests of inline hosts.

    Args:
        requests: counts the requests in flight at each host.
        bell: of the workers.
        num_cores: cores that this process and its workers may use.
        clock: monotonic seconds; read only between the envs of inline hosts.

    Attributes:
        bell, num_cores: as given.
        inline: the inline hosts; the next is the first.
    """

    def __init__(
        self,
        requests: Requests,
        bell: TrainerBell,
        num_cores: int,
        clock: Callable[[], float],
    ) -> None:
        self.bell = bell
        self.num_cores = num_cores
        self.inline: deque[tuple[int, Executing]] = deque()
        self._requests = requests
        self._clock = clock
        self._on_bell: dict[int, Host] = {}
        self._on_loop: list[int] = []
        # The listeners, each with the hosts that share it.
        self._servers: list[tuple[Server, list[int]]] = []
        self._spinner = Spinner(enabled=True)
        self._spun = False

    def add(self, host: Host) -> None:
        """Add a host of the group."""
        if isinstance(host, Executing):
            self.inline.append((host.host_id, host))
        elif isinstance(host, SelfStarting):
            for server, host_ids in self._servers:
                if server is host.server:
                    host_ids.append(host.host_id)
                    break
            else:
                self._servers.append((host.server, [host.host_id]))
        elif host.on_bell:
            self._on_bell[host.host_id] = host
        if host.needs_loop:
            self._on_loop.append(host.host_id)

    # -- reading results --------------------------------------------------------------

    def poll(self) -> None:
        """Read results that are ready without a wake-up."""
        on_bell = self._on_bell
        for host_id in self.bell.with_news() if on_bell else ():
            on_bell[host_id].poll()
        for server, host_ids in self._servers:
            if any(map(self._requests.in_flight.__getitem__, host_ids)):
                server.poll()

    def execute(self, wanted: int, until: float | None) -> bool:
        """Execute requests of inline hosts: one, or `wanted` if no other host has any in flight.

        Args:
            wanted: the largest number of requests to execute.
            until: monotonic seconds at which to stop, between two envs.

        Returns True if any request was executed.
        """
        hosts, in_flight = self.inline, self._requests.in_flight
        if len(hosts) < len(in_flight):
            own = sum([in_flight[host_id] for host_id, _ in hosts])
            wanted = wanted if own == sum(in_flight) else 1
        is_over = None if until is None else lambda: self._clock() >= until
        count = num_idle = 0
        while count < wanted and num_idle < len(hosts):
            _, host = hosts[0]
            hosts.rotate(-1)  # In turn, so that none waits forever.
            executed = host.execute(wanted - count, is_over)
            count, num_idle = count + executed, 0 if executed else num_idle + 1
            if executed and is_over is not None and is_over():
                break
        return count > 0

    # -- waiting for workers ----------------------------------------------------------

    def spin(self, wanted: int) -> bool:
        """Spin briefly for `wanted` results; True if they are ready.

        Spin only while there are more cores than busy workers and clients (which may run on this
        machine), and while no env that shares this thread is busy, as it couldn't make progress.
        """
        in_flight = self._requests.in_flight
        self._spun = False
        if any(in_flight[host_id] for host_id in self._on_loop):
            return False
        num_busy = 0
        for host_id in self._on_bell:
            if in_flight[host_id]:
                num_busy += 1
        servers: list[Server] = []
        for server, host_ids in self._servers:
            if count := sum(map(in_flight.__getitem__, host_ids)):
                num_busy += count
                servers.append(server)
        self._spun = 0 < num_busy < self.num_cores
        if not self._spun:
            return False
        self.bell.disarm()
        unread = self.bell.unread
        if not servers:
            return self._spinner.spin(lambda: unread() >= wanted)
        return self._spinner.spin(
            lambda: unread() >= wanted or any(server.is_readable() for server in servers)
        )

    def slept(self) -> None:
        """Report to the spinner that a spin was followed by a sleep."""
        if self._spun:
            self._spinner.slept()

    def arm(self, wanted: int) -> bool:
        """Have the workers wake this process when `wanted` results are ready, or all in flight.

        Args:
            wanted: the number that the call with the fewest waits for.

        Returns True if they are ready already, so no wake-up needs to be awaited.
        """
        bell, in_flight = self.bell, self._requests.in_flight
        total = sum(map(in_flight.__getitem__, self._on_bell))
        if not total:
            bell.disarm()
            return False
        wanted = min(wanted, total)
        return bell.arm(bell.read[-1] + wanted, at_last=wanted == total)
