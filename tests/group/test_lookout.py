"""Whom the trainer asks to wake it, and for how many results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.group.lookout import Lookout


@dataclass(eq=False)
class Worker:
    """As much of a host as a lookout sees."""

    in_flight: int
    ordered: int = 0
    elastic: bool = False
    inline: bool = False
    looked_at: int = 0

    def order(self, count: int) -> bool:
        self.ordered = count
        return False

    def withdraw(self) -> None:
        self.ordered = 0

    def unread(self) -> int:
        self.looked_at += 1
        return self.in_flight


def lookout(*workers: Any) -> Lookout:
    return Lookout(list(workers))


def note_steps(look: Any, workers: list[Worker], ns: float) -> None:
    """Until nothing else is remembered."""
    for worker in workers * 200:
        look.note_step(worker, ns)


def test_for_all_results_one_worker_is_asked_for_all_of_its_own() -> None:
    """A bell of any other would wake the trainer for nothing."""
    first, second = Worker(16), Worker(16)
    lookout(first, second).order(32)
    assert sorted([first.ordered, second.ordered]) == [0, 16]


def test_the_worker_that_was_last_is_asked_the_next_time() -> None:
    """Which of two is the slower one mostly stays so."""
    quick, slow = Worker(8), Worker(8)
    look = lookout(quick, slow)
    look.order(16)
    quick.in_flight, slow.in_flight = 0, 3
    look.order(3)
    quick.in_flight = slow.in_flight = 8
    look.order(16)
    assert (quick.ordered, slow.ordered) == (0, 8)
    # And if it is the other for once:
    quick.in_flight, slow.in_flight = 3, 0
    look.order(3)
    quick.in_flight = slow.in_flight = 8
    look.order(16)
    assert (quick.ordered, slow.ordered) == (8, 0)


@given(
    in_flight=st.lists(st.integers(1, 64), min_size=1, max_size=8),
    wanted=st.integers(1, 512),
    step_us=st.floats(0.1, 1e5),
)
def test_orders_can_be_met_and_come_in_time(
    in_flight: list[int], wanted: int, step_us: float
) -> None:
    """Where steps are long, whoever rings first rings when enough may be ready, not later."""
    workers = [Worker(count) for count in in_flight]
    look = lookout(*workers)
    note_steps(look, workers, step_us * 1e3)
    wanted = min(wanted, sum(in_flight))
    look.order(wanted)
    asked = [worker for worker in workers if worker.ordered]
    assert asked
    assert all(worker.ordered <= worker.in_flight for worker in asked)
    if step_us > 1000:
        silent = sum(w.ordered - 1 if w.ordered else w.in_flight for w in workers)
        assert silent < wanted


def test_short_steps_are_waited_for_in_larger_numbers_but_nobody_runs_dry() -> None:
    """A worker that rings has at least a quarter of its steps still to do."""
    workers = [Worker(16), Worker(16)]
    look = lookout(*workers)
    note_steps(look, workers, 5e3)
    look.order(16)
    assert [worker.ordered for worker in workers] == [12, 12]


def test_long_steps_are_not_waited_for_because_others_are_short() -> None:
    """A group may hold simulators of very different speed."""
    quick, slow = workers = [Worker(16), Worker(16)]
    look = lookout(*workers)
    note_steps(look, [quick], 5e3)
    note_steps(look, [slow], 5e6)
    look.order(16)
    assert (quick.ordered, slow.ordered) == (12, 8)


def test_clients_on_this_machine_are_left_the_cores() -> None:
    """As many of them may want one as owe a result."""
    client = Worker(2, elastic=True)
    look = lookout(client)
    look.num_cores = 2
    assert not look.spin(1)
    assert not client.looked_at
    client.in_flight = 1
    assert look.spin(1)


def test_steps_that_take_no_time_are_no_trouble() -> None:
    """A client need not tell how long its env took."""
    workers = [Worker(16), Worker(16)]
    look = lookout(*workers)
    for step_ns in (0.0, 5e-324):
        note_steps(look, workers, step_ns)
        look.order(16)
        assert [worker.ordered for worker in workers] == [12, 12]
