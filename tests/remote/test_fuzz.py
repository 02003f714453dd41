"""Nonsense does no harm: no exception escapes, nothing piles up, service goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from patience import HANG
from remote.disturbed import disturbed
from remote.fuzz import fuzz, fuzz_keys

if TYPE_CHECKING:
    from pathlib import Path

FRAMES = 4_000
"""For each end and seed; `benchmarks/fuzz_remote.py` does 100,000."""


def test_spoilt_keys_keep_nobody_out(tmp_path: Path) -> None:
    """Whatever lies beside it, and whatever it is called."""
    assert fuzz_keys(200, 0, tmp_path) == 0


def test_strangers_cost_nothing_that_stays() -> None:
    """Each of their connections ends, and the client that is served meanwhile goes on."""
    with disturbed(curve=False, messages=2_000, rate=10**6) as (group, listener, strangers):
        batch, _ = group.reset()
        steps = 0
        while strangers.poll() is None or listener.door.num_strangers:
            group.step_async(batch.respond(action=[0]))
            batch, _ = group.collect_async(deadline=HANG)
            steps += 1
        assert steps
        assert listener.malformed > 10
        assert group["robots-0"].clients == ["robots-0/c0"]


@pytest.mark.parametrize("seed", range(2))
def test_spoilt_messages_do_no_harm(seed: int) -> None:
    """Between them, every request is answered."""
    findings = fuzz(FRAMES, seed)
    assert findings.steps >= FRAMES // 25
    assert findings.malformed > FRAMES // 2
    assert findings.grown < 200_000  # pytest keeps what was logged.
