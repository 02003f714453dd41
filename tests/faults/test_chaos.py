"""Random faults under load: the short form of `benchmarks/chaos.py`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from patience import HANG

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def report_of(script: str, folder: Path, *arguments: str) -> dict[str, Any]:
    """Return the report of a script, which must end well."""
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


def test_every_request_ends_once_with_its_own_data(tmp_path: Path) -> None:
    """With twenty random faults, no request is lost, answered twice, or answered with
    other data.
    """
    report = report_of("chaos.py", tmp_path, "--faults", "20")
    assert report["faults"] == dict.fromkeys(("killed", "stopped", "hung", "raised", "exited"), 4)
    assert sum(report["ends"].values()) == sum(report["requests"].values()) > 20
    assert report["noticed_ms"]["deaths"]["count"] == 8
    assert report["noticed_ms"]["hung"]["count"] == 4
    assert not report["broken"]
    assert not report["leaks"]


def test_parallel_groups_survive_every_kind_of_fault(
    tmp_path: Path,
) -> None:
    """Sixty faults in three groups, each with its own driver, and in their clients."""
    report = report_of("chaos.py", tmp_path, "--groups", "3", "--faults", "60")
    assert sum(report["faults"].values()) >= 60
    assert sum(report["ends"].values()) == sum(report["requests"].values()) > 60
    assert all(report["drivers"][name] for name in ("asyncio", "uvloop", "sync"))
    assert not report["broken"]
    assert not report["leaks"]
