"""The public interface doesn't grow unseen: whoever adds a name raises a number here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "interface.py"
MOST = {
    "names": 70,
    "members": 345,
    "arguments": 386,
    "fields": 24,
    "commands": 9,
    "options": 31,
    "extras": 15,
}


def test_the_interface_is_no_larger_than_agreed() -> None:
    """The counts are what `python benchmarks/interface.py` prints last."""
    run = subprocess.run([sys.executable, SCRIPT], capture_output=True, check=True, text=True)
    *_, last = run.stdout.splitlines()
    found = {name: int(count) for name, count in map(str.split, last.split(", "))}
    assert found.keys() == MOST.keys()
    assert all(found[name] <= most for name, most in MOST.items()), found
