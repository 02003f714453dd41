"""An example config, rolled out by the command line to its closing table."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from cli.command import COMMAND

ROOT = Path(__file__).parents[2]


def closing_table(name: str, *words: str) -> dict[str, list[str]]:
    """Cells of each line, by name, of ``rollout configs/NAME.yaml`` with `words`."""
    done = subprocess.run(
        [*COMMAND, "rollout", f"configs/{name}.yaml", *words],
        cwd=ROOT,
        env={**os.environ, "COLUMNS": "120"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    title, *lines = done.stdout.splitlines()
    assert "steps in" in title, done.stdout
    return {cells[0]: cells for cells in map(str.split, lines) if cells}


def steps(cells: list[str]) -> int:
    """The number of steps."""
    return int(cells[1].replace(",", ""))
