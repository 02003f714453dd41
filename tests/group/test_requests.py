"""Requests and their checked table; that only legal events happen, random programs show."""

from __future__ import annotations

import numpy as np
import pytest
from kit.checked import CheckedRequests

from rlightning_aio._core.group.state.request_states import COLLECTOR, State
from rlightning_aio.protocol.entries import Operation

HOST_OF = np.array([0, 1, 1])


def test_a_late_reply_has_no_effect() -> None:
    """That of a request which another has taken the place of, after a death."""
    table = CheckedRequests(HOST_OF, 2)
    slots = np.array([1])
    (late,) = table.issue(slots, Operation.STEP, COLLECTOR, 1.0).tolist()
    table.in_flight[1] = 0
    (entry,) = table.ask_again(1, slots).tolist()
    assert table.end(1, late) is None
    assert not len(table.complete([(1, np.array([late]))]))
    assert table.state[1] == State.BUSY
    assert table.complete([(1, np.array([entry]))]).tolist() == [1]


def test_the_checked_table_refuses_an_illegal_event_and_a_change_without_one() -> None:
    """The error names the event, the slot and its state, and nothing has changed."""
    table = CheckedRequests(HOST_OF, 2)
    slots = table.alone(1)
    table.issue(slots, Operation.STEP, COLLECTOR, 1.0)
    with pytest.raises(RuntimeError, match="SENT can't happen to slot 1, which is BUSY for COLL"):
        table.issue(slots, Operation.STEP, COLLECTOR, 1.0)
    assert table.state[1] == State.BUSY
    table.state[1] = State.IDLE
    with pytest.raises(RuntimeError, match="slot 1 became IDLE for COLLECTOR without"):
        table.drop(slots)
