"""Rings: both sides over one block of memory, in any order of events, and in real processes."""

from __future__ import annotations

import mmap
import os
import random
import socket
import sys
import threading
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from protocol.memory_of_rings import both_sides, memory_size, unused

from rlightning_aio.protocol.entries import (
    NUMBER_SHIFT,
    SLOT_MASK,
    Operation,
    entry,
    number_of,
    op_of,
    slot_of,
)
from rlightning_aio.protocol.exchange import REQUESTS_SENT
from rlightning_aio.protocol.rings import bell_size

if TYPE_CHECKING:
    from types import FrameType

    from rlightning_aio.protocol.rings import WorkerRings

STEP = Operation.STEP

pytestmark = pytest.mark.usefixtures("implementation")


class RingsMachine(RuleBasedStateMachine):
    """Entries arrive once, in order; a sleeping side is rung according to the rules.

    This process drives both sides, so each event is atomic; the test with two processes covers
    the rest.
    """

    @initialize(rows=st.integers(1, 6))
    def start(self, rows: int) -> None:
        self.rows = rows
        self.bell, self.trainer, self.worker = both_sides(rows)
        self.number = 0
        self.requested: deque[int] = deque()
        self.reported: deque[int] = deque()
        self.frames = [0, 0]
        self.asleep = False
        # The armed number of reports, and the number that needs no further ring.
        self.armed: int | None = None
        self.settled: int | None = None
        self.read = 0

    @precondition(lambda self: self.room())
    @rule(data=st.data())
    def request(self, data: st.DataObject) -> None:
        count = data.draw(st.integers(1, self.room()))
        entries = [entry(self.number + k + 1, k, STEP) for k in range(count)]
        self.number += count
        self.requested.extend(entries)
        assert self.trainer.request(np.array(entries, np.int64)) == self.asleep

    def room(self) -> int:
        """Send requests to idle envs, since each may have only one in flight."""
        return self.rows - len(self.requested) - len(self.reported)

    @precondition(lambda self: not self.asleep)
    @rule(data=st.data())
    def serve(self, data: st.DataObject) -> None:
        bells: list[int] = []
        executed: list[int] = []
        in_rows = [data.draw(st.booleans()) for _ in self.requested]

        def execute(request: int) -> bool:
            executed.append(request)
            return in_rows[len(executed) - 1]

        served = self.worker.serve(
            execute, unused, lambda: bells.append(len(executed)), unused, [], 0
        )
        assert served == bool(self.requested)
        assert executed == list(self.requested)
        self.reported += [done for done, in_row in zip(executed, in_rows, strict=True) if in_row]
        self.requested.clear()
        assert len(bells) == (served and self.look())

    def look(self) -> bool:
        """Expect a ring after a report: one for each arming, once there are enough reports,
        and none for a disarmed bell.
        """
        enough = self.armed is None or self.read + len(self.reported) >= self.armed
        if self.armed == self.settled or not enough:
            return False
        self.settled = self.armed
        return self.armed is not None

    @precondition(lambda self: self.room())
    @rule()
    def report(self) -> None:
        """Report an entry that came in a frame."""
        self.number += 1
        done = entry(self.number, 0, Operation.RESET)
        bells: list[int] = []
        self.worker.report(done, lambda: bells.append(done))
        self.reported.append(done)
        assert len(bells) == self.look()

    @rule()
    def read_reports(self) -> None:
        assert self.trainer.reports().tolist() == list(self.reported)
        self.read += len(self.reported)
        self.reported.clear()

    @rule(count=st.integers(1, 6))
    def order(self, count: int) -> None:
        self.bell.arm(self.bell.goal(count), at_last=False)
        # A goal that was armed too late takes effect at the next check.
        self.armed = self.read + count

    @rule()
    def withdraw(self) -> None:
        self.bell.disarm()
        self.armed = None

    @rule()
    def send_frame(self) -> None:
        self.frames[0] += 1
        assert self.trainer.count_frame() == self.asleep

    @precondition(lambda self: self.frames[0] >= 0)
    @rule()
    def see_frame(self) -> None:
        """Also before it is counted: the trainer counts a frame after it has written it."""
        self.frames[0] -= 1
        self.worker.frame_seen()

    @rule()
    def send_frame_back(self) -> None:
        self.worker.count_frame()
        self.frames[1] += 1

    @precondition(lambda self: not self.asleep)
    @rule()
    def fall_asleep(self) -> None:
        something = bool(self.requested or self.frames[0] > 0)
        self.asleep = self.worker.fall_asleep()
        assert self.asleep == (not something)

    @precondition(lambda self: self.asleep)
    @rule()
    def wake_up(self) -> None:
        self.worker.wake_up()
        self.asleep = False

    @invariant()
    def both_sides_agree(self) -> None:
        if not hasattr(self, "trainer"):
            return
        assert self.bell.unread() == len(self.reported)
        assert self.bell.with_news() == [0] * bool(self.reported)
        assert self.trainer.has_frame() == (self.frames[1] > 0)
        assert self.worker.has_frame() == (self.frames[0] > 0)
        assert self.worker.has_news() == bool(self.frames[0] > 0 or self.requested)


def test_rings() -> None:
    """In any order of events."""
    run_state_machine_as_test(RingsMachine, settings=settings(stateful_step_count=40))


@given(
    number=st.integers(0, (1 << (63 - NUMBER_SHIFT)) - 1),
    slot=st.integers(0, SLOT_MASK),
    op=st.sampled_from((0, *Operation)),
)
def test_an_entry_holds_number_slot_and_operation(number: int, slot: int, op: int) -> None:
    """All three are recovered from one 64-bit word."""
    packed = int(np.int64(entry(number, slot, op)))
    assert (number_of(packed), slot_of(packed), op_of(packed)) == (number, slot, op)


def test_a_batch_of_steps_becomes_resets_by_adding_a_mask() -> None:
    """The trainer makes resets in this way."""
    steps = np.array([entry(k + 1, k, Operation.STEP) for k in range(3)])
    found = steps + np.array([False, True, False])
    assert [op_of(one) for one in found.tolist()] == [STEP, Operation.RESET, STEP]


@pytest.mark.parametrize("count", [-1, 9, 1 << 62, -(1 << 63)])
def test_an_impossible_count_is_an_error_of_the_other_side(count: int) -> None:
    """Whoever wrote it: nothing is read, so nothing is read beyond a ring."""
    memory = memoryview(bytearray(memory_size(3)))
    bell, trainer, worker = both_sides(3, memory)
    bell.counters[0] = count
    with pytest.raises(RuntimeError, match="memory that isn't its own"):
        trainer.reports()
    memory[bell_size(1) :].cast("q")[REQUESTS_SENT] = count
    with pytest.raises(RuntimeError, match="in a ring for 4"):
        worker.serve(lambda _: True, unused, unused, unused, [], 0)
    with pytest.raises(RuntimeError, match="in a ring for 4"):
        worker.requests()


def test_the_trainer_sees_the_entry_in_execution_and_its_start() -> None:
    """The entry is 0 while nothing is executed."""
    _, trainer, worker = both_sides(3)
    assert trainer.current()[0] == 0
    worker.begin(entry(7, 2, STEP), 123)
    assert trainer.current() == (entry(7, 2, STEP), 123)
    worker.idle()
    assert trainer.current()[0] == 0


def _work(rings: WorkerRings, channel: socket.socket) -> None:
    """A worker without envs, which ends when the trainer closes the channel."""
    while True:
        if rings.serve(lambda _: True, unused, lambda: channel.send(b"!"), unused, [], 0):
            continue
        if rings.fall_asleep():
            if not channel.recv(1 << 16):
                return
            rings.wake_up()


def test_two_processes_never_miss_each_other() -> None:
    """In thousands of rounds in which either side may fall asleep at the wrong moment."""
    rows = 5
    memory = memoryview(mmap.mmap(-1, memory_size(rows)))
    bell, rings, worker = both_sides(rows, memory)
    ours, theirs = socket.socketpair()
    pid = os.fork()
    if pid == 0:
        ours.close()
        try:
            _work(worker, theirs)
        finally:
            os._exit(0)
    theirs.close()
    draw, number = random.Random(0), 0
    for _ in range(4000):
        count = draw.randint(1, rows)
        entries = [entry(number + k, k, STEP) for k in range(count)]
        number += count
        if rings.request(np.array(entries, np.int64)):
            ours.send(b"!")
        found: list[int] = []
        while len(found) < count:
            wanted = draw.randint(1, count - len(found))
            bell.arm(bell.goal(wanted), at_last=draw.random() < 0.5)
            if bell.unread() < wanted:
                ours.recv(1 << 16)
            found += rings.reports().tolist()
        assert found == entries
    ours.close()
    assert os.waitpid(pid, 0)[1] == 0


def test_each_thread_has_its_own_fence() -> None:
    """Several groups may be used in several threads."""
    failures: list[RuntimeError] = []

    def work() -> None:
        _, trainer, _ = both_sides(1)
        try:
            for _ in range(20_000):
                trainer.worker_sleeps()
        except RuntimeError as failure:
            failures.append(failure)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert not failures


def test_a_fence_works_after_an_interrupt_in_the_previous_one() -> None:
    """For Ctrl-C at any point."""
    _, trainer, _ = both_sides(1)
    struck = 0

    def strike(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal lines
        if frame.f_code.co_name != "fence":
            return strike
        if event == "line":
            lines -= 1
            if lines == 0:
                raise KeyboardInterrupt
        return strike

    for first in range(1, 10):
        lines = first
        sys.settrace(strike)
        try:
            trainer.worker_sleeps()
        except KeyboardInterrupt:
            struck += 1
        finally:
            sys.settrace(None)
        trainer.worker_sleeps()
    assert 2 <= struck < 9


def test_only_what_was_asked_to_stop_stops() -> None:
    """Not an env that is being built or closed: that is no request, and has the number 0."""
    _, trainer, worker = both_sides(3)
    worker.begin(entry(0, 1, 0), 0)
    assert worker.to_stop(0) == []
    trainer.stop(2, 5)
    assert worker.to_stop(0) == [2]
    worker.begin(entry(5, 2, STEP), 0)
    assert [worker.to_stop(0) for _ in range(2)] == [[2], [2]]
    worker.begin(entry(0, 2, 0), 0)
    assert worker.to_stop(0) == []
    worker.begin(entry(6, 2, STEP), 0)
    assert worker.to_stop(0) == []
