"""Nonsense does no harm: no exception escapes, nothing accumulates, requests are answered."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from remote.fuzz import fuzz

if TYPE_CHECKING:
    import pytest

FRAMES = 1_000
"""For each end."""


def test_corrupted_messages_do_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    """Every request between them is answered."""
    caplog.set_level(logging.ERROR, "rlightning_aio.remote")  # Which pytest keeps.
    findings = fuzz(FRAMES, 0)
    assert findings.steps >= FRAMES // 25
    assert findings.grown < 200_000
