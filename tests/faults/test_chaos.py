"""Random faults under load, counted: the short form of a benchmark that anyone can run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from patience import HANG

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def report_of(script: str, folder: Path, *arguments: str) -> dict[str, Any]:
    """What a script that ends well has to report."""
    out = folder / "report.json"
    run = subprocess.run(
        [sys.executable, BENCHMARKS / script, *arguments, "--json", out],
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return json.loads(out.read_text())


def test_every_request_ends_once_and_truly_whatever_breaks(tmp_path: Path) -> None:
    """Twenty random faults: no request is lost or answered twice, or with another's data."""
    report = report_of("chaos.py", tmp_path, "--faults", "20")
    assert report["faults"] == dict.fromkeys(("killed", "stopped", "hung", "raised", "exited"), 4)
    assert sum(report["ends"].values()) == sum(report["requests"].values()) > 20
    assert report["noticed_ms"]["deaths"]["count"] == 8
    assert report["noticed_ms"]["hung"]["count"] == 4
    assert not report["broken"]
    assert not report["leaks"]


def test_groups_side_by_side_keep_their_promises_through_every_kind_of_fault(
    tmp_path: Path,
) -> None:
    """Sixty faults against three groups, each on a driver of its own, and their clients."""
    report = report_of("chaos.py", tmp_path, "--groups", "3", "--faults", "60")
    assert sum(report["faults"].values()) >= 60
    assert sum(report["ends"].values()) == sum(report["requests"].values()) > 60
    assert all(report["drivers"][name] for name in ("asyncio", "uvloop", "sync"))
    assert not report["broken"]
    assert not report["leaks"]
