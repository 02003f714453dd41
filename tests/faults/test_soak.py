"""Groups that are built and closed leave nothing behind: the short form of `benchmarks/soak.py`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from patience import HANG

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "soak.py"


def test_groups_in_a_row_leak_nothing(tmp_path: Path) -> None:
    """After six groups of both kinds there is no additional descriptor or process.

    One fork server is kept for the next group.
    """
    out = tmp_path / "report.json"
    run = subprocess.run(
        [sys.executable, SCRIPT, "--cycles", "6", "--steps", "3000", "--json", out],
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    report = json.loads(out.read_text())
    samples = report["samples"]
    assert [found["cycle"] for found in samples] == list(range(1, 7))
    assert samples[-1]["steps"] >= 3000
    assert [found["children"] for found in samples] == [1] * 6
    assert report["growth"]["descriptors"] == report["growth"]["shared_memory"] == 0
