"""The bell: a worker rings when the goal is reached, and not before."""

from __future__ import annotations

import itertools
import mmap
import os
import random
import select
import socket
from typing import Any, NoReturn

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from protocol.memory_of_rings import unused

from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.rings import (
    TrainerBell,
    TrainerRings,
    WorkerBell,
    WorkerRings,
    bell_size,
    rings_size,
)

pytestmark = pytest.mark.usefixtures("implementation")


class Worker:
    """A worker, divided at its memory accesses.

    Attributes:
        waiting: requests to execute; count: reports since its start.
        looks: True if it is about to check the bell.
        rung: goals for which it has rung since its start.
    """

    def __init__(self, bell: WorkerBell) -> None:
        self.bell = bell
        self.waiting = self.count = 0
        self.looks = False
        self.rung: list[tuple[int, int, bool]] = []


class BellMachine(RuleBasedStateMachine):
    """A trainer that arms, disarms, reads and restarts, and workers that report and check.

    Checks may come between the events of others: concurrent events are tested in every
    order.
    """

    @initialize(num_workers=st.sampled_from([1, 2, 3, 12, 13, 20]))
    def start(self, num_workers: int) -> None:
        self.memory = memoryview(bytearray(bell_size(num_workers)))
        self.trainer = TrainerBell(self.memory, num_workers)
        self.workers = [self.new_worker(k) for k in range(num_workers)]
        self.read = [0] * num_workers
        # The order that stands: number of its kind of counting, sum to come to, at last.
        self.order: tuple[int, int, bool] | None = None
        self.restarts = 0
        self.rung = False

    def new_worker(self, index: int) -> Worker:
        num_workers = (len(self.memory) // 64) - 1
        return Worker(WorkerBell(self.memory, num_workers, index))

    def worker(self, data: st.DataObject, among: list[int] | None = None) -> Worker:
        indices = range(len(self.workers)) if among is None else among
        return self.workers[data.draw(st.sampled_from(list(indices)))]

    def unread(self) -> list[int]:
        return [w.count - read for w, read in zip(self.workers, self.read, strict=True)]

    # -- the trainer

    @rule(data=st.data(), count=st.integers(1, 5))
    def submit(self, data: st.DataObject, count: int) -> None:
        self.worker(data).waiting += count

    @rule(wanted=st.integers(1, 12), at_last=st.booleans())
    def arm(self, wanted: int, at_last: bool) -> None:
        goal = self.trainer.goal(wanted)
        assert goal == sum(self.read) + wanted
        order = (self.restarts, goal, at_last)
        self.trainer.arm(goal, at_last=at_last)
        if order != self.order:
            self.order, self.rung = order, False
        if sum(self.unread()) >= wanted:
            self.rung = True  # The trainer sees it and does not sleep.

    @rule()
    def disarm(self) -> None:
        self.trainer.disarm()
        self.order = None

    @rule(data=st.data())
    def take(self, data: st.DataObject) -> None:
        for index in self.trainer.with_news():
            if data.draw(st.booleans()):
                count = self.trainer.counters[index] - self.read[index]
                self.trainer.took(index, count)
                self.read[index] += count

    @rule(data=st.data())
    def restart(self, data: st.DataObject) -> None:
        index = data.draw(st.sampled_from(range(len(self.workers))))
        self.trainer.restart(index)
        self.workers[index] = self.new_worker(index)
        self.read[index] = 0
        self.restarts += 1
        self.order = None

    # -- workers

    def can_report(self) -> list[int]:
        return [k for k, w in enumerate(self.workers) if w.waiting and not w.looks]

    def can_look(self) -> list[int]:
        return [k for k, w in enumerate(self.workers) if w.looks]

    @precondition(lambda self: self.can_report())
    @rule(data=st.data())
    def report(self, data: st.DataObject) -> None:
        worker = self.worker(data, self.can_report())
        worker.waiting -= 1
        worker.count += 1
        looks = worker.bell.publish(worker.count)
        assert not (looks and self.order is not None and self.order[2])
        # It also checks when it runs out of work.
        worker.looks = looks or not worker.waiting

    @precondition(lambda self: self.can_look())
    @rule(data=st.data())
    def look(self, data: st.DataObject) -> None:
        worker = self.worker(data, self.can_look())
        worker.looks = False
        if not worker.bell.is_due():
            return
        assert self.order is not None
        assert sum(w.count for w in self.workers) >= self.order[1]
        assert self.order not in worker.rung
        worker.rung.append(self.order)
        self.rung = True

    # -- invariants

    @invariant()
    def nobody_sleeps_on_enough(self) -> None:
        if getattr(self, "order", None) is None:
            return
        _, goal, at_last = self.order
        if self.rung or sum(w.count for w in self.workers) < goal:
            return
        # The worker that reached it is about to check, or has more work and checks afterwards.
        assert self.can_look() or (at_last and any(w.waiting for w in self.workers))

    @invariant()
    def the_trainer_knows_what_is_unread(self) -> None:
        if not hasattr(self, "trainer"):
            return
        unread = self.unread()
        assert self.trainer.unread() == sum(unread)
        assert self.trainer.with_news() == [k for k, count in enumerate(unread) if count]
        assert list(self.trainer.counters) == [w.count for w in self.workers]


def test_the_bell() -> None:
    """In any order of events."""
    run_state_machine_as_test(BellMachine, settings=settings(stateful_step_count=60))


def bells(num_workers: int) -> tuple[TrainerBell, list[WorkerBell]]:
    memory = memoryview(bytearray(bell_size(num_workers)))
    trainer = TrainerBell(memory, num_workers)
    return trainer, [WorkerBell(memory, num_workers, k) for k in range(num_workers)]


@pytest.mark.parametrize("num_workers", [2, 13])
@pytest.mark.parametrize("at_last", [False, True])
def test_one_of_several_workers_that_finish_together_rings(num_workers: int, at_last: bool) -> None:
    """In any order of reports and checks, with each worker's report before its check."""
    events = [("publish", 0), ("look", 0), ("publish", 1), ("look", 1)]
    orders = [
        order
        for order in itertools.permutations(events)
        if all(order.index(("publish", k)) < order.index(("look", k)) for k in range(2))
    ]
    assert len(orders) == 6
    for order in orders:
        trainer, workers = bells(num_workers)
        trainer.arm(trainer.goal(2), at_last=at_last)
        rung = [0, 0]
        for what, index in order:
            if what == "publish":
                workers[index].publish(1)
            else:
                rung[index] += workers[index].is_due()
        assert sum(rung) >= 1, order
        # Two if neither checked before both had published.
        both_first = {what for what, _ in order[:2]} == {"publish"}
        assert sum(rung) == 1 + both_first, order


def test_for_all_results_workers_check_when_they_run_out_of_work() -> None:
    """Not after each report, which would need a fence each time."""
    trainer, (worker, _) = bells(2)
    trainer.arm(trainer.goal(300), at_last=True)
    assert not any(worker.publish(count) for count in range(1, 300))
    trainer.arm(trainer.goal(301), at_last=False)
    assert worker.publish(300)


def test_a_disarmed_bell_is_not_rung() -> None:
    """The trainer is already awake; arming again, even with the same goal, is new."""
    trainer, (worker,) = bells(1)
    trainer.arm(trainer.goal(2), at_last=False)
    trainer.disarm()
    worker.publish(2)
    assert not worker.is_due()
    trainer.took(0, 2)
    for round_ in (3, 4):
        trainer.arm(trainer.goal(1), at_last=False)
        worker.publish(round_)
        assert worker.is_due()
        assert not worker.is_due()
        trainer.took(0, 1)
        trainer.disarm()


def test_a_released_bell_is_silent() -> None:
    """Its memory may be gone, and it no longer reads it."""
    trainer, (worker,) = bells(1)
    worker.publish(3)
    trainer.release()
    assert trainer.unread() == 0
    assert trainer.with_news() == []
    trainer.arm(trainer.goal(1), at_last=False)
    worker.publish(4)
    assert not worker.is_due()


def _work(rings: WorkerRings, channel: socket.socket) -> None:
    """A worker without envs, which ends when the trainer closes the channel."""
    while True:
        if rings.serve(lambda _: True, unused, lambda: channel.send(b"!"), unused, [], 0):
            continue
        if rings.fall_asleep():
            if not channel.recv(1 << 16):
                return
            rings.wake_up()


def _work_and_exit(
    bell: memoryview,
    num_workers: int,
    index: int,
    rings: memoryview,
    num_envs: int,
    channel: socket.socket,
    others: list[socket.socket],
) -> NoReturn:
    try:
        for other in others:
            other.close()
        _work(WorkerRings(rings, num_envs, WorkerBell(bell, num_workers, index)), channel)
    finally:
        os._exit(0)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("num_workers", "rounds"), [(3, 1500), (13, 300)])
def test_a_trainer_of_several_processes_is_never_left_asleep(num_workers: int, rounds: int) -> None:
    """In thousands of rounds with workers that finish nearly together."""
    envs = 4
    bell_bytes, ring_bytes = bell_size(num_workers), rings_size(envs)
    memory = memoryview(mmap.mmap(-1, bell_bytes + num_workers * ring_bytes))
    bell = TrainerBell(memory[:bell_bytes], num_workers)
    parts = [memory[bell_bytes + k * ring_bytes :][:ring_bytes] for k in range(num_workers)]
    rings = [TrainerRings(part, envs, bell, k) for k, part in enumerate(parts)]
    channels: list[socket.socket] = []
    pids: list[int] = []
    for k, part in enumerate(parts):
        ours, theirs = socket.socketpair()
        channels.append(ours)
        pid = os.fork()
        if pid == 0:
            _work_and_exit(memory[:bell_bytes], num_workers, k, part, envs, theirs, channels)
        pids.append(pid)
        theirs.close()
    draw, number = random.Random(0), 0
    try:
        for _ in range(rounds):
            asked = [draw.randint(0, envs) for _ in range(num_workers)]
            for k, count in enumerate(asked):
                entries = [entry(number + n, n, Operation.STEP) for n in range(count)]
                if count and rings[k].request(np.array(entries, np.int64)):
                    channels[k].send(b"!")
            number += envs
            found = 0
            while found < sum(asked):
                left = sum(asked) - found
                bell.arm(bell.goal(left), at_last=True)
                if bell.unread() < left:
                    _any_bell(channels)
                found += sum(len(rings[k].reports()) for k in bell.with_news())
            assert found == sum(asked)
    finally:
        for ours in channels:
            ours.close()
        ended = [os.waitpid(pid, 0)[1] for pid in pids]
    assert ended == [0] * num_workers


def _any_bell(channels: list[socket.socket]) -> None:
    """Sleep until a worker rings, and read its bells."""
    readable: list[Any] = select.select(channels, [], [])[0]
    for channel in readable:
        channel.recv(1 << 16)
