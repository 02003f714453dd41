"""Each program in ``examples/`` runs as it stands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANG

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda p: p.stem)
def test_it_runs(example: Path) -> None:
    """It ends well, prints something, and has nothing to complain about."""
    # Asyncio's debug mode, which holds for tests, would log what takes longer than a blink.
    environment = {name: v for name, v in os.environ.items() if name != "PYTHONASYNCIODEBUG"}
    done = subprocess.run(
        [sys.executable, "-W", "error", example],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout


def test_the_two_loops_are_short() -> None:
    """What shows how little it takes takes little: some fifteen lines that do something."""
    for name in ("async_loop", "sync_loop"):
        lines = (ROOT / "examples" / f"{name}.py").read_text().splitlines()
        assert len([line for line in lines if line.strip()]) <= 17
