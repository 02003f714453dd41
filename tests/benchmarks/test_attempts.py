"""benchmarks/attempts.py: what was injected is what is found, and nothing is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "attempts.py"


def test_outcomes_equal_the_faults_that_were_injected() -> None:
    """No failure has a reward; every group is complete but those whose agent is stuck."""
    few = ["--tasks", "6", "--in-flight", "400", "--seconds", "1"]
    command = [sys.executable, str(SCRIPT), *few]
    ended = subprocess.run(command, capture_output=True, check=True, text=True)
    report = json.loads(ended.stdout)
    for found in (report["loop"], report["workers"]):
        assert found["injected"]
        assert found["failures"] == found["injected"]
        stuck = found["injected"]["timed_out (either)"]  # Which isn't tried again.
        assert found["rewards"] == {"4.0": 48 - stuck, "None": stuck}
        assert (found["groups"], found["left"]) == (6, 0)
        assert 6 - stuck <= found["complete"] < 6
    for found in report["in_flight"].values():
        assert 0 < found["lag_p99_ms"] <= found["lag_max_ms"]
        assert found["us_per_step"] > 0
