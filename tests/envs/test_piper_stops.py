"""An arm stops when a process that drives it ends, by any signal; also its watchdog."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("piper_sdk")
pytest.importorskip("serial")

pytestmark = pytest.mark.simulators


def load_harness() -> Any:
    path = Path(__file__).parents[2] / "benchmarks" / "arm_stops.py"
    spec = importlib.util.spec_from_file_location("arm_stops", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["arm_stops"] = module  # Dataclasses need it there.
    spec.loader.exec_module(module)
    return module


arm_stops = load_harness()


@pytest.mark.parametrize(("place", "event", "during"), arm_stops.ROWS)
def test_arms_stop_as_configured(place: str, event: str, during: str) -> None:
    """Three arms under way, one for each kind of stop, come nowhere near their target.

    What was only stopped and goes on moves nothing: a late command doesn't reach the arm.
    """
    found = arm_stops.measure(place, event, during)
    assert len(found) == len(arm_stops.STOPS)
    for one in found:
        assert one.degrees < 100  # On their way were more than 170.
        assert one.moved_again < 1
