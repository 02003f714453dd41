"""Deaths in the log: a line for each at first, then one line a minute."""

from __future__ import annotations

import math
import re

import pytest

from rlightning_aio._core.group.supervision.fault_messages import CrashLog


class Log:
    """A `CrashLog` with a clock, and the lines that it has written."""

    def __init__(self, caplog: pytest.LogCaptureFixture) -> None:
        self.log, self.now, self._caplog = CrashLog(), 1000.0, caplog

    def die(self, times: int = 1, *, entry: str = "e", every: float = 1.0, **more: str) -> None:
        """Note deaths, and look every second whether something is due, as the supervisor does."""
        for number in range(times):
            cause = more.get("cause", "was killed by SIGKILL (if you didn't, see dmesg)")
            env_id = more.get("env_id", f"{entry}-0")
            self.log.note(entry, f"death {number} of {entry}", cause, env_id, self.now)
            self.pass_time(every)

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        if self.now >= self.log.due:
            self.log.flush(self.now)

    @property
    def lines(self) -> list[str]:
        found = [record.getMessage() for record in self._caplog.records]
        self._caplog.clear()
        return found


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> Log:
    return Log(caplog)


def test_the_first_deaths_of_an_entry_have_a_line_each(log: Log) -> None:
    """The third says what comes next; another entry has its own three."""
    log.die(3)
    log.die(1, entry="f")
    more = "; further restarts in entry 'e' are counted, in one line a minute"
    assert log.lines == ["death 0 of e", "death 1 of e", f"death 2 of e{more}", "death 0 of f"]


def test_further_deaths_are_one_line_a_minute_and_none_is_lost(log: Log) -> None:
    log.die(3)
    assert len(log.lines) == 3
    log.die(600, every=0.5)
    lines = log.lines
    assert len(lines) == 5
    log.log.flush(log.now, everything=True)
    counts = [int(re.findall(r"'e': (\d+) further restart", line)[0]) for line in lines + log.lines]
    assert sum(counts) == 600
    assert max(counts) <= 121


def test_a_count_says_of_what_and_where(log: Log) -> None:
    """In one short line, without advice, which the first lines had."""
    log.die(3)
    log.die(8, env_id="e-1")
    log.die(5, cause="exited with code 3", env_id="e-2")
    for number in range(4):
        log.die(cause=f"could not be rebuilt: error {number}")
    assert len(log.lines) == 3
    log.pass_time(60)
    (line,) = log.lines
    assert line == (
        "entry 'e': 17 further restarts within 77 s: was killed by SIGKILL "
        "(8), exited with code 3 (5), could not be rebuilt: error 0 (1), others (3); while "
        "executing e-1 (8), e-2 (5), e-0 (4)"
    )
    assert log.log.due == math.inf


def test_deaths_of_unknown_cause_are_counted(log: Log) -> None:
    for _ in range(4):
        log.log.note("e", "a death", "ended with its fork server: it exited", None, log.now)
    log.pass_time(60)
    expected = "entry 'e': 1 further restart within 60 s: "
    assert log.lines[3] == f"{expected}ended with its fork server: it exited (1)"


def test_the_last_counts_come_a_minute_after_a_burst(log: Log) -> None:
    """Though no further worker dies; those of two entries each in their own time."""
    log.die(3)
    log.die(3, entry="f")
    log.die(2)
    log.pass_time(30)
    log.die(1, entry="f")
    assert len(log.lines) == 6
    log.pass_time(27)
    assert ["'e': 2 further" in line for line in log.lines] == [True]
    log.pass_time(32)
    assert ["'f': 1 further" in line for line in log.lines] == [True]


def test_after_a_quiet_time_deaths_have_lines_of_their_own_again(log: Log) -> None:
    """As have those that are rare."""
    log.die(4)
    log.pass_time(301)
    log.lines.clear()
    log.die(2)
    assert log.lines == ["death 0 of e", "death 1 of e"]
    log.pass_time(301)
    log.die(10, every=150)
    assert len(log.lines) == 10
