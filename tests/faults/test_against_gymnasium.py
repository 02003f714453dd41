"""The same faults in Gymnasium's AsyncVectorEnv and in this package, compared by results.

Gymnasium's side is asserted, too: if it improves, the README must change.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from patience import HANG

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "differences.py"


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the script's findings by situation and library."""
    out = tmp_path_factory.mktemp("differences") / "found.json"
    run = subprocess.run(
        [sys.executable, SCRIPT, "--json", out],
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(out.read_text())


def test_late_step_is_not_taken_for_the_next_one(found: dict[str, Any]) -> None:
    """After a timeout, Gymnasium answers the second step with the results of the first."""
    theirs, ours = found["a step that comes late"].values()
    assert theirs["raised"].startswith("TimeoutError")
    assert (theirs["asked"], theirs["answered"]) == (2.0, [1.0, 1.0])
    assert ours["raised"].startswith("TimeoutError")
    assert ours["late"] == [1.0, 1.0]
    assert (ours["asked"], ours["answered"]) == (2.0, [2.0, 2.0])


def test_killed_worker_is_named_with_its_cause_and_replaced(found: dict[str, Any]) -> None:
    """Gymnasium reports neither env nor cause, and can't step any more."""
    theirs, ours = found["a killed worker"].values()
    assert theirs["raised"].split(":")[0] in {"EOFError", "ConnectionResetError"}
    assert "SIGKILL" not in theirs["raised"]
    assert theirs["afterwards"].startswith("AlreadyPendingCallError")
    assert ours["marked"].startswith("was killed by SIGKILL")
    assert ours["unhurt"] == 1.0
    assert ours["afterwards"] == "answers [2.0, 2.0]"


def test_error_that_cant_be_rebuilt_arrives_complete(found: dict[str, Any]) -> None:
    """Gymnasium raises the error of rebuilding it, and the original text is lost."""
    theirs, ours = found["an error that can't be rebuilt"].values()
    assert theirs["raised"].startswith("TypeError: OddError.__init__()")
    assert theirs["afterwards"].startswith("AlreadyPendingCallError")
    assert ours["env_id"] == "e-1"
    assert "breakable.OddError: the simulator failed with code 7" in ours["raised"]
    assert "OddError(code=7)" in ours["traceback"]
    assert ours["unhurt"] == 1.0
    assert ours["afterwards"] == "answers [2.0, 2.0]"
