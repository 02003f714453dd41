"""Nonsense does no harm: no exception escapes, nothing piles up, service goes on."""

from __future__ import annotations

import pytest
from remote.fuzz import fuzz

FRAMES = 4_000
"""For each end and seed; `benchmarks/fuzz_remote.py` does 100,000."""


@pytest.mark.parametrize("seed", range(3))
def test_spoilt_messages_do_no_harm(seed: int) -> None:
    """Between them, every request is answered."""
    findings = fuzz(FRAMES, seed)
    assert findings.steps >= FRAMES // 25
    assert findings.malformed > FRAMES // 2
    assert findings.grown < 200_000  # pytest keeps what was logged.
