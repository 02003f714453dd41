"""Restarts in the log: the first ones of an entry, then every hundredth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio._core.group.supervision.fault_messages import CrashLog

if TYPE_CHECKING:
    import pytest


def test_a_crash_loop_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """The third line says what comes next; another entry has its own three."""
    log = CrashLog()
    for number in range(1, 251):
        log.note("e", f"death {number}")
    log.note("f", "death of f", "Traceback\n  here\n")
    then = "; restart {0} of entry 'e', of which every 100th is logged"
    assert [record.getMessage() for record in caplog.records] == [
        "death 1",
        "death 2",
        *(f"death {k}{then.format(k)}" for k in (3, 100, 200)),
        "death of f\nTraceback\n  here",
    ]
