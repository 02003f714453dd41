"""The programs of docs/torchrl.md and docs/rllib.md run as they stand."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANG

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.simulators
@pytest.mark.parametrize(
    ("page", "needed"), [("torchrl", ["torchrl"]), ("rllib", ["ray", "tree", "torch"])]
)
def test_program_runs(page: str, needed: list[str], tmp_path: Path) -> None:
    """To its end, and prints what it says."""
    if missing := [name for name in needed if importlib.util.find_spec(name) is None]:
        pytest.skip(f"{', '.join(missing)} not installed")
    text = (DOCS / f"{page}.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    program = tmp_path / "program.py"
    program.write_text(block)
    done = subprocess.run(
        [sys.executable, program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
