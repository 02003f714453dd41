"""benchmarks/attempts.py: what was injected is what is found, and nothing is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "attempts.py"


def test_outcomes_equal_the_faults_that_were_injected() -> None:
    """Every group is complete, and no failure has a reward."""
    few = ["--tasks", "6", "--in-flight", "400", "--seconds", "1"]
    command = [sys.executable, str(SCRIPT), "--json", *few]
    ended = subprocess.run(command, capture_output=True, check=True, text=True)
    report = json.loads(ended.stdout.splitlines()[-1])
    for found in (report["loop"], report["workers"]):
        assert found["injected"]
        mine = found["play"]
        assert (mine["groups"], mine["complete"], mine["left"]) == (6, 6, 0)
        assert mine["failures"] == found["injected"]
        assert mine["rewards"] == {"4.0": 48}
        assert found["gather"]["end"] != "ended"
        assert found["gather"]["attempts"] < 48
    assert report["first 6"]["freed_s"] > 0
    for found in report["freed"].values():
        assert found["begun_s"] > found["free_s"] > 0
    assert report["alone_us_per_step"] > 0
    for found in report["in_flight"].values():
        assert 0 < found["lag_p99_ms"] <= found["lag_max_ms"]
        assert found["us_per_step"] > 0
    assert report["kib_per_attempt"] > 0
