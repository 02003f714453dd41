"""Rings: what is in an entry, impossible counts, fences, and what must stop.

That no entry is lost, random programs show, `test_interleavings`, and `test_bell` in processes.
"""

from __future__ import annotations

import sys
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from protocol.memory_of_rings import both_sides, memory_size, unused

from rlightning_aio.protocol import kernel
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


STEP = Operation.STEP

pytestmark = pytest.mark.usefixtures("implementation")


@given(
    number=st.integers(0, (1 << (63 - NUMBER_SHIFT)) - 1),
    slot=st.integers(0, SLOT_MASK),
    op=st.sampled_from((0, *Operation)),
)
def test_an_entry_holds_number_slot_and_operation(number: int, slot: int, op: int) -> None:
    """All three are recovered from one 64-bit word."""
    packed = int(np.int64(entry(number, slot, op)))
    assert (number_of(packed), slot_of(packed), op_of(packed)) == (number, slot, op)


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
        kernel.serve(worker.side, lambda _: True, unused, unused, unused, [], 0, worker.fence)
    with pytest.raises(RuntimeError, match="in a ring for 4"):
        worker.requests()


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
    assert worker.to_stop(0, whatever=True) == [2]
    worker.idle()
    assert worker.to_stop(5, whatever=True) == worker.to_stop(5) == []  # Its envs are 5, 6 and 7.
