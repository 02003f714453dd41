"""benchmarks/attempts.py: every reward is that of the ledger, and nothing is left behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from run_python import output_of

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "attempts.py"


def reported(*words: str) -> dict[str, Any]:
    return json.loads(output_of(SCRIPT, *words))


def test_no_reward_differs_from_the_ledger_while_much_fails() -> None:
    """Groups are complete but for reasons that are named; no sandbox is left."""
    report = reported("--faults", "--tasks", "30", "--away", "0.5", "--blocked", "0.01")
    for found in (report["with faults"], report["without"]):
        assert found["groups"] == 30
        assert found["wrong rewards"] == found["sandboxes left"] == 0
        assert 30 - sum(found["failed"].values()) <= found["complete"]
    assert report["with faults"]["tries that failed"]
    assert report["without"]["failed"] == report["without"]["tries that failed"] == {}
    assert report["without"]["complete"] == 30


def test_attempts_in_flight_are_measured() -> None:
    for found in reported("--in-flight", "400", "--seconds", "1")["in_flight"].values():
        assert 0 < found["lag_p99_ms"] <= found["lag_max_ms"]
        assert found["us_per_step"] > 0
