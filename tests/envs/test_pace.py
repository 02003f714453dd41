"""The control rate: deadlines on a grid, and no rush after a delay."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.envs.pace import Pace


class FakeTime:
    def __init__(self) -> None:
        self.now = 100.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_the_rate_is_independent_of_the_duration_of_work() -> None:
    """Work shorter than a period doesn't shift the grid, for any number of steps."""
    time = FakeTime()
    pace = Pace(10.0, time.clock, time.sleep)
    for step in range(1, 1001):
        time.now += 0.03 + 0.05 * (step % 2)
        assert pace.wait() == 0.0
        assert time.now == pytest.approx(100.0 + step * 0.1)


def test_a_short_delay_is_made_up_for() -> None:
    """A step that overruns by half a period is reported, and the next one is on the grid."""
    time = FakeTime()
    pace = Pace(10.0, time.clock, time.sleep)
    time.now += 0.15
    assert pace.wait() == pytest.approx(0.05)
    assert pace.wait() == 0.0
    assert time.now == pytest.approx(100.2)


def test_a_restart_begins_a_new_grid() -> None:
    """After a restart the next deadline is one period away."""
    time = FakeTime()
    pace = Pace(10.0, time.clock, time.sleep)
    time.now += 7.0
    pace.restart()
    assert pace.wait() == 0.0
    assert time.now == pytest.approx(107.1)


@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=50))
def test_delays_never_end_in_a_rush(delays: list[float]) -> None:
    """After any delays, two successive idle waits take at least one period."""
    time = FakeTime()
    pace = Pace(10.0, time.clock, time.sleep)
    for delay in delays:
        time.now += delay
        pace.wait()
        before = time.now
        pace.wait()
        pace.wait()
        assert time.now - before >= 0.1 - 1e-9
