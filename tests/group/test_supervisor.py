"""The life of hosts: no process, no driver, and a manual clock."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import pytest
from group.fake_host import ACTION_SPACE, PLAIN, FakeGroup, Running

from rlightning_aio._core.group.engine.steps import CollectRules
from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.messages import Attached, Died
from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import EnvHung, GroupClosed, StartFailed
from rlightning_aio.protocol.slab import RowLayout
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning_aio._core.group.state.host_record import HostLoss


def is_replaced(loss: HostLoss | None) -> TypeGuard[HostLoss]:
    return loss is not None and loss.replaced


def is_given_up(loss: HostLoss | None) -> TypeGuard[HostLoss]:
    return loss is not None and not loss.replaced


class Fleet(FakeGroup):
    """A group whose clock and driver are the test's, and which notes the outcome of each death."""

    def __init__(self, counts: tuple[int, ...] = (1, 1), **fields: Any) -> None:
        super().__init__(counts, up=False, **{"start_timeout": 10.0, **fields})
        self.log = self.shared.log
        self.requests, self.lifetime = self.core.requests, self.core.lifetime
        self.supervisor = self.core.supervisor
        self.losses: list[HostLoss | None] = []
        handle_exit = self.supervisor.handle_exit

        def noted(exited: Died) -> HostLoss | None:
            self.losses.append(handle_exit(exited))
            return self.losses[-1]

        self.supervisor.handle_exit = noted
        self.supervisor.overdue.begin = lambda now: None  # Its times would come between others.

    def turn(self) -> None:
        while True:
            self.drain()
            super().turn()
            if not self.shared.completions:
                return

    def drain(self) -> None:
        self.core.apply_completions()
        self.wake()

    def start(self) -> Running:
        return self.begin(self.core.start(self.now))

    def ask(self, *slots: int) -> list[int]:
        """Send steps; return their entries."""
        ids = [f"fake-{slot}" for slot in slots]
        batch = BatchedData(ids, [PolicyResponse(env_id, PLAIN) for env_id in ids])
        self.steps.step_async(batch, self.now)
        return self.entries(*slots)

    def entries(self, *slots: int) -> list[int]:
        return self.requests.numbering.entry[list(slots)].tolist()

    def check(self) -> None:
        self.supervisor.check(self.now)
        self.drain()

    def let(self, seconds: float) -> None:
        """Let time pass, and look at the hosts whenever that is due, as a call that waits."""
        end = self.now + seconds
        while (due := self.supervisor.next_check()) is not None and due <= end:
            self.now = max(self.now, due)
            self.check()
        self.now = end

    def wait(self) -> float:
        """Let time pass until the supervisor has something to do; return how long that took."""
        due = self.supervisor.next_check()
        assert due is not None
        passed, self.now = due - self.now, due
        self.check()
        return passed

    def die(self, host_id: int, *requests: int) -> HostLoss | None:
        """Let a worker die while it executes `requests`; return the outcome."""
        self.hosts[host_id].die(*requests)
        self.drain()
        return self.losses[-1]

    def reply(self, slot: int) -> None:
        """Complete a request and collect it."""
        self.finish(slot)
        self.begin(self.steps.collect(self.now, CollectRules())).result()

    def end(self) -> Running:
        return self.begin(self.supervisor.shutdown.close(self.now))


@pytest.fixture
def fleet() -> Iterator[Callable[..., Fleet]]:
    """Make fleets, started unless the test starts them, and close them after the test."""
    made: list[Fleet] = []

    def make(counts: tuple[int, ...] = (1, 1), *, up: bool = True, **fields: Any) -> Fleet:
        made.append(Fleet(counts, **fields))
        if up:
            made[-1].start().result()
            made[-1].log.clear()
        return made[-1]

    yield make
    while made:
        ours = made.pop()
        closing = ours.end()
        ours.pass_time(5)
        ours.pass_time(5)
        assert closing.done
        del ours


# -- start


def test_all_are_started_before_any_is_waited_for(fleet: Callable[..., Fleet]) -> None:
    """Rows are assigned when the last host is built; metadata is in the order of slots."""
    ours = fleet((2, 1, 1), up=False)
    ours.hosts[1].builds = False
    start = ours.start()
    assert ours.log == ["start 0", "start 1", "start 2"]
    assert start.until == ours.now + 10
    ours.now += 3
    ours.hosts[1].build()
    ours.turn()
    assert ours.log[3:] == ["attach 0", "attach 1", "attach 2"]
    metas = start.result()
    assert [meta.env_id for meta in metas] == ["fake-0", "fake-1", "fake-2", "fake-3"]
    assert ours.start().result() is metas
    assert len(ours.log) == 6


@pytest.mark.parametrize("dies", [True, False])
def test_a_late_one_is_dumped_killed_and_given_up(fleet: Callable[..., Fleet], dies: bool) -> None:
    """It has some time to write its stacks; then the start fails, dead or not."""
    ours = fleet(up=False)
    ours.hosts[1].builds = ours.hosts[1].closes = False
    ours.hosts[1].dies = dies
    start = ours.start()
    ours.pass_time(9.9)
    assert ours.log == ["start 0", "start 1"]
    ours.pass_time(0.1)
    assert ours.log[2] == "dump and kill 1"
    if not dies:
        assert ours.log[3:] == []
        assert start.until == ours.now + times.DUMP
        ours.pass_time(times.DUMP)
        assert ours.log[3:] == ["close 0", "close 1"]
        ours.pass_time(1.5)
        assert ours.log[5:] == ["kill 1"]
        ours.pass_time(0.3)
    assert ours.log[-2:] == ["release 0", "release 1"]
    with pytest.raises(StartFailed, match=r"env 'fake-1' .* did not start within 10.0 s"):
        start.result()


# -- hangs


def test_a_host_that_survives_a_kill_is_destroyed_with_its_fork_server(
    fleet: Callable[..., Fleet],
) -> None:
    """Some seconds after the kill, and again if that has no effect, either."""
    ours = fleet((1,), step_timeout=5.0)
    (entry,) = ours.ask(0)
    ours.hosts[0].current = (entry, int(ours.now * 1e9))
    ours.hosts[0].dies = False
    ours.now += 60  # However late the trainer is.
    ours.check()
    for destroyed in range(1, 3):
        ours.check()
        ours.let(times.OBEY - 0.1)
        assert len(ours.log) == destroyed
        ours.let(0.1)
        assert ours.log == ["dump and kill 0"] + destroyed * ["destroy 0"]
        ours.check()
    loss = ours.die(0)
    assert is_replaced(loss)
    assert loss.death.cause == "hung in a step and was killed"
    assert ours.supervisor.next_check() is None or ours.supervisor.next_check() > ours.now
    ours.now += 60
    ours.check()
    assert ours.log.count("destroy 0") == 2


def test_a_killed_host_has_its_time_if_the_trainer_was_stopped(fleet: Callable[..., Fleet]) -> None:
    """It was stopped while it ordered the kill."""
    ours = fleet((1,), step_timeout=5.0)
    (host,) = ours.hosts
    (entry,) = ours.ask(0)
    host.current, host.dies = (entry, int(ours.now * 1e9)), False
    host.kill = stopped_in(host.kill, ours)  # type: ignore[method-assign]
    ours.now += 5
    ours.check()
    ours.check()
    assert ours.log == ["dump and kill 0"]
    ours.let(times.OBEY - 0.1)
    assert ours.log == ["dump and kill 0"]
    ours.let(0.1)
    assert ours.log == ["dump and kill 0", "destroy 0"]


def test_a_death_that_was_read_with_another_one_destroys_nothing(
    fleet: Callable[..., Fleet],
) -> None:
    """The fork server tells of the deaths of all its workers, and the trainer reads that late."""
    ours = fleet((1, 1), step_timeout=5.0)
    for host, entry in zip(ours.hosts, ours.ask(0, 1), strict=True):
        host.current, host.dies = (entry, int(ours.now * 1e9)), False
    ours.now += 5
    ours.check()
    ours.check()
    ours.hosts[0].unread = [host.die for host in ours.hosts]
    ours.now += 60
    ours.check()
    assert len(ours.losses) == 2
    assert ours.log[:2] == ["dump and kill 0", "dump and kill 1"]
    assert not [line for line in ours.log if line.startswith("destroy")]


def ended_as_hung(ours: Fleet) -> HostLoss:
    """Return the outcome for host 0, whose time is almost over, or is by the next look."""
    ours.let(0.1 + 5.0 / 4)
    assert ours.log[0] == "dump and kill 0"
    (loss,) = ours.losses
    assert is_replaced(loss)
    return loss


def test_an_answered_request_is_not_blamed_for_a_hang(fleet: Callable[..., Fleet]) -> None:
    """A worker was stopped between two requests: the one that it has not begun is named."""
    ours = fleet((2,), step_timeout=5.0)
    entries = ours.ask(0, 1)
    ours.hosts[0].current = (entries[0], 0)
    ours.reply(0)
    ours.check()
    ours.now += 5
    ours.check()
    (loss,) = ours.losses
    assert is_replaced(loss)
    assert loss.error(loss.owed).env_id == "fake-1"


def test_an_event_loop_that_goes_on_is_not_killed(fleet: Callable[..., Fleet]) -> None:
    """It says so while all envs wait. Once it stops, it is killed, and nobody is named."""
    ours = fleet((3,), awaits=True, step_timeout=5.0)
    ours.ask(0, 2)
    for _ in range(3):
        ours.hosts[0].current = (0, int(ours.now * 1e9))
        ours.let(4.9)
    assert ours.log == []
    loss = ended_as_hung(ours)
    assert loss.why[2:] == ("infrastructure", None)
    assert loss.death.cause == "hung and was killed"
    error = loss.error(loss.owed)
    assert isinstance(error, EnvHung)
    assert error.env_id == "fake-0"
    assert "no env's code was running; envs that owed a reply: fake-0, fake-2" in str(error)


def test_an_unread_death_does_not_cost_the_fork_server(
    fleet: Callable[..., Fleet],
) -> None:
    """The kill has worked; other workers depend on the fork server."""
    ours = fleet((1,), step_timeout=5.0)
    (entry,) = ours.ask(0)
    ours.hosts[0].current = (entry, int(ours.now * 1e9))
    ours.hosts[0].dies = False
    ours.now += 5
    ours.check()
    ours.hosts[0].unread.append(ours.hosts[0].end)
    ours.now += 60
    ours.check()
    assert ours.log == ["dump and kill 0", "start 0", "attach 0"]


def test_hosts_are_looked_at_a_few_times_within_the_shortest_limit(
    fleet: Callable[..., Fleet],
) -> None:
    """However often a call waits meanwhile: so limits cost a step nothing."""
    ours = fleet((1,) * 8, step_timeout=8.0, reset_timeout=100.0)
    looks = 0

    def looked(current: Callable[[], tuple[int, int]]) -> Callable[[], tuple[int, int]]:
        def look() -> tuple[int, int]:
            nonlocal looks
            looks += 1
            return current()

        return look

    for host in ours.hosts:
        host.current_request = looked(host.current_request)  # type: ignore[method-assign]
    entries = ours.ask(*range(8))
    for _ in range(800):
        for host, entry in zip(ours.hosts, entries, strict=True):
            host.current = (entry, int(ours.now * 1e9))
        ours.check()
        ours.now += 0.01
    assert 0 < looks <= 8 * 5


@pytest.mark.parametrize("begun", [0.0, 0.1, 1.9, 2.0, 3.3])
@pytest.mark.parametrize("idle", [False, True])
def test_a_hang_is_ended_in_time(fleet: Callable[..., Fleet], begun: float, idle: bool) -> None:
    """When its time is over; of a worker that executes nothing, at most a quarter later."""
    ours = fleet((1, 1), step_timeout=8.0)
    ours.ask(1)
    ours.hosts[1].traffic = 1
    ours.let(begun)
    (entry,) = ours.ask(0)
    if not idle:
        ours.hosts[0].current = (entry, int(ours.now * 1e9))
    ours.let(7.9 - begun)  # The other one is not found before that.
    assert ours.log == []
    ours.reply(1)
    ours.let(begun)
    assert ours.log == []
    ours.let(2.1 if idle else 0.11)
    assert ours.log[0] == "dump and kill 0"


def test_a_limit_of_milliseconds_is_not_looked_at_all_the_time(
    fleet: Callable[..., Fleet],
) -> None:
    """A hang may take some of them longer then."""
    ours = fleet((1,), step_timeout=0.001)
    (entry,) = ours.ask(0)
    ours.hosts[0].current = (entry, int(ours.now * 1e9) + 1)
    ours.check()
    ours.let(0.02)
    assert ours.log[0] == "dump and kill 0"


def test_an_aborted_request_that_exceeds_its_limit_is_no_hang(
    fleet: Callable[..., Fleet],
) -> None:
    """Its worker is replaced as after any abort, at once and only once."""
    ours = fleet((1,), step_timeout=0.1, on_worker_death="raise")
    (entry,) = ours.ask(0)
    ours.hosts[0].current = (entry, int(ours.now * 1e9))
    ours.hosts[0].dies = False
    aborting = ours.begin(ours.core.abort(ours.now, None))
    ours.now += 0.1
    for _ in range(2):
        ours.check()
        assert ours.log == ["kill 0"]
    ours.hosts[0].end()
    ours.drain()
    ours.turn()
    assert aborting.done
    (loss,) = ours.losses
    assert is_replaced(loss)
    assert loss.death.cause == "was killed because a step was aborted"


@pytest.mark.parametrize("second", [0, 1])
def test_each_aborted_request_has_its_time_to_end(fleet: Callable[..., Fleet], second: int) -> None:
    """Whatever was aborted just before, of the same env or of another of its worker."""
    ours = fleet((2,))
    ours.ask(0)
    ours.begin(ours.core.abort(ours.now, None))
    ours.finish(0)
    ours.now += 0.15
    ours.ask(second)
    ours.begin(ours.core.abort(ours.now, None))
    ours.now += 0.1
    ours.check()
    assert ours.log == []
    ours.now += 0.15
    ours.check()
    assert ours.log == ["kill 0", "start 0", "attach 0"]


def test_without_a_limit_a_request_may_take_any_time(fleet: Callable[..., Fleet]) -> None:
    """So may a call, and a reset if only steps have a limit."""
    free, limited = fleet(), fleet(step_timeout=5.0)
    for ours in (free, limited):
        (entry,) = ours.ask(0)
        if ours is limited:
            ours.reply(0)
            ours.begin(ours.core.reset(ours.now, None, None, ["fake-0"]))
            (entry,) = ours.entries(0)
        ours.hosts[0].current = (entry, int(ours.now * 1e9))
        ours.now += 1e6
        ours.check()
        assert ours.log == []


# -- deaths


def test_deaths_of_nobody_are_counted_until_any_env_completes_a_step(
    fleet: Callable[..., Fleet],
) -> None:
    ours = fleet((2,), awaits=True, max_restarts=2)
    for turn in range(4):
        ours.ask(0, 1)
        assert is_replaced(ours.die(0, 0))
        if ours.supervisor.next_check() is not None:
            ours.wait()
        for slot in (0, 1):  # Resets, which prove nothing.
            ours.reply(slot)
        if turn == 1:
            ours.ask(1)
            ours.reply(1)
    ours.ask(0, 1)
    assert is_given_up(ours.die(0, 0))


def test_a_replacement_gets_no_requests_that_were_aborted(fleet: Callable[..., Fleet]) -> None:
    """Nor an empty batch in their place, which a Ray actor would execute."""
    ours = fleet((2, 1), max_restarts=1)
    host = ours.hosts[0]
    host.builds = False
    asked = ours.ask(0)
    ours.die(0)
    asked += ours.ask(1)
    aborted = ours.supervisor.detector.abort(np.array([0]), ours.now)
    assert [host_id for host_id, _ in aborted] == [0]
    host.build()
    ours.shared.completions.append(Attached(0))
    ours.drain()
    assert host.asked == asked


def test_the_time_of_a_start_counts_from_the_death(fleet: Callable[..., Fleet]) -> None:
    """Not from the last time that the supervisor ran."""
    ours = fleet()
    ours.now += 1000
    ours.hosts[0].attach = lambda _: None  # type: ignore[method-assign]
    ours.ask(0)
    ours.die(0)
    ours.check()
    assert ours.log == ["start 0"]
    assert ours.supervisor.next_check() == ours.now + 10


def test_a_replacement_with_other_spaces_gets_no_requests(fleet: Callable[..., Fleet]) -> None:
    """Its results would not fit the rows."""
    ours = fleet(max_restarts=1)
    ours.hosts[0].dies = False
    (entry,) = ours.ask(0)
    started = ours.supervisor.records[0].started
    other = RowLayout(ACTION_SPACE, ACTION_SPACE, (), ())
    started[0] = replace(started[0], layout=other)
    ours.die(0)
    assert ours.log == ["start 0", "attach 0", "kill 0"]
    assert ours.hosts[0].asked == [entry]
    ours.hosts[0].end()
    ours.drain()
    assert "its spaces changed with the restart" in str(ours.requests.collector.faults[0])


def test_a_replacement_is_not_late_if_the_trainer_is(
    fleet: Callable[..., Fleet],
) -> None:
    """It was up in time."""
    ours = fleet(max_restarts=1)
    host = ours.hosts[0]
    host.builds = False
    ours.ask(0)
    ours.die(0)
    host.unread += [host.build, lambda: ours.shared.completions.append(Attached(0))]
    ours.now += 60
    ours.check()
    assert ours.log == ["start 0", "attach 0"]
    assert len(host.asked) == 2


def test_a_replacement_has_its_time_anew_if_the_trainer_was_late(
    fleet: Callable[..., Fleet],
) -> None:
    """It was stopped while it ordered the start, or it wrote the rest of the order only now."""
    ours = fleet(max_restarts=1)
    host = ours.hosts[0]
    host.builds, host.attach = False, stopped_in(host.attach, ours)  # type: ignore[method-assign]
    ours.ask(0)
    ours.die(0)
    ours.check()
    assert ours.supervisor.next_check() == ours.now + 10
    for write in (lambda: setattr(host, "traffic", 7), lambda: host.unread.append(lambda: None)):
        ours.now += 60
        write()
        ours.check()
        assert ours.supervisor.next_check() == ours.now + 10
    assert ours.log == ["start 0", "attach 0"]
    ours.now += 10
    ours.check()
    assert ours.log == ["start 0", "attach 0", "dump and kill 0"]


def test_a_first_start_has_its_time_from_when_it_was_ordered(
    fleet: Callable[..., Fleet],
) -> None:
    """Also if the trainer was stopped meanwhile."""
    ours = fleet((1,), up=False)
    (host,) = ours.hosts
    host.builds = False
    host.start, host.attach = stopped_in(host.start, ours), stopped_in(host.attach, ours)  # type: ignore[method-assign]
    starting = ours.start()
    ours.pass_time(9)
    host.build()
    host.built = False
    ours.pass_time(0)
    ours.pass_time(9)
    ours.shared.completions.append(Attached(0))
    ours.turn()
    starting.result()
    assert ours.log == ["start 0", "attach 0"]


def stopped_in(order: Callable[..., None], ours: Fleet) -> Callable[..., None]:
    """The trainer is stopped for a minute when it has given an order."""

    def given(*arguments: Any, **more: Any) -> None:
        order(*arguments, **more)
        ours.now += 60

    return given


# -- close


def test_a_death_while_closing_closes_the_host(fleet: Callable[..., Fleet]) -> None:
    """Nothing is replaced, and no wait goes on; a host that was given up is closed already."""
    ours = fleet((1, 1), max_restarts=0)
    assert is_given_up(ours.die(1))
    ours.hosts[0].closes = False
    closing = ours.end()
    assert ours.die(0) is None
    ours.turn()
    assert closing.done
    assert ours.log == ["close 0", "release 0", "release 1"]
    with pytest.raises(GroupClosed, match="while this call was waiting"):
        ours.check()


def test_closing_does_not_wait_for_a_restart(fleet: Callable[..., Fleet]) -> None:
    """A host that is down has nothing to close, and is not started again."""
    ours = fleet(max_restarts=9)
    ours.hosts[0].refusals = math.inf
    ours.die(0)
    closing = ours.end()
    assert closing.done
    assert ours.log == ["close 1", "release 0", "release 1"]
    ours.now += 50
    with pytest.raises(GroupClosed):
        ours.check()
    assert "start 0" not in ours.log
