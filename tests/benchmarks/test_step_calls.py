"""How many Python calls a step makes on the trainer's side: no more than was agreed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from rlightning_aio.protocol import kernel

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "step_calls.py"
# The Python twins of the compiled kernel are functions that count, in a file of their own.
TWINS = 0 if kernel.selected == "c" else 7
STEP = {"calls": 50 + TWINS, "functions": 41 + TWINS, "files": 12 + (TWINS > 0)}
MOST = {
    "step_async and collect_async": STEP,
    "the same, asynchronous": STEP,
    "step": STEP,
    "VectorEnv.step": {"calls": 71 + TWINS},
    # It steps twice. A round may wait once more in the second, if a worker is late: 294 to 309.
    "Collector.collect, 16 transitions": {"calls": 309 + 2 * TWINS},
}


def test_a_step_makes_few_calls() -> None:
    """The counts are exact, so a step that passes by one more object is noticed here."""
    command = [sys.executable, str(SCRIPT), "--json"]
    # The debug mode of asyncio, in which tests run, makes calls of its own.
    surroundings = {name: value for name, value in os.environ.items() if "DEBUG" not in name}
    ended = subprocess.run(command, capture_output=True, check=True, text=True, env=surroundings)
    found = json.loads(ended.stdout)
    for name, limits in MOST.items():
        for what, most in limits.items():
            assert found[name][what] <= most, (name, what, found[name])
