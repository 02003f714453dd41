"""A queue of episodes while workers end in any way, and the evaluation itself, too."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from patience import HANG

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "queue_faults.py"


def test_each_episode_is_played_exactly_once_whatever_ends() -> None:
    """Workers are killed, abort, hang and exit, and the evaluation is killed and resumed: results
    are those without faults. ``benchmarks/queue_faults.py`` alone is the long form.
    """
    short = ("--episodes", "60", "--faults", "4", "--kills", "2", "--step-timeout", "1")
    done = subprocess.run(
        [sys.executable, SCRIPT, *short],
        capture_output=True, text=True, timeout=HANG, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("60 episodes in ")
