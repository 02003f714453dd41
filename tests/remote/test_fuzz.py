"""Nonsense does no harm: no exception escapes, nothing accumulates, requests are answered."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest
from patience import HANG
from remote.disturbed import disturbed
from remote.fuzz import fuzz, fuzz_keys

if TYPE_CHECKING:
    from pathlib import Path

FRAMES = 1_000
"""For each end."""


def test_corrupted_key_files_keep_no_client_out(tmp_path: Path) -> None:
    """A good key counts, whatever other files there are and whatever their names."""
    assert fuzz_keys(200, 0, tmp_path) == 0


@pytest.mark.parametrize("curve", [False, True])
def test_unauthenticated_peers_leave_nothing_behind(curve: bool) -> None:
    """Each of their connections ends, at its first bad message, and the client is served.

    With keys, none of their messages is read.
    """
    with disturbed(curve=curve, messages=1_000 if curve else 5_000) as (group, listener, peers):
        batch, _ = group.reset()
        steps = 0
        while peers.poll() is None or listener.connections.num_unauthenticated:
            group.step_async(batch.respond(action=[0]))
            batch, _ = group.collect_async(deadline=HANG)
            steps += 1
        assert steps
        assert (listener._sessions.num_malformed > 5) != curve
        assert group["robots-0"].clients == ["robots-0/c0"]


def test_corrupted_messages_do_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    """Every request between them is answered."""
    caplog.set_level(logging.ERROR, "rlightning_aio.remote")  # Which pytest keeps.
    findings = fuzz(FRAMES, 0)
    assert findings.steps >= FRAMES // 25
    assert findings.malformed > FRAMES // 2
    assert findings.grown < 200_000
