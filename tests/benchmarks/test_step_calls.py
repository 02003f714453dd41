"""How many Python calls a step makes on the trainer's side: no more than was agreed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rlightning_aio.protocol import kernel

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "step_calls.py"
# The Python twins of the compiled kernel are functions that count, in a file of their own.
TWINS = 0 if kernel.selected == "c" else 7
STEP = {"calls": 44 + TWINS, "functions": 40 + TWINS, "files": 12 + (TWINS > 0)}
MOST = {
    "step": STEP | {"calls": 42 + TWINS},
    "step_async and collect_async": STEP,
    "VectorEnv.step": {"calls": 68 + TWINS},
    # It steps twice. A round may wait once more in the second, if a worker is late: 294 to 309.
    "Collector.collect, 16 transitions": {"calls": 309 + 2 * TWINS},
}


@pytest.mark.parametrize("limits", [[], ["--step-timeout", "10"]])
def test_a_step_makes_few_calls(limits: list[str]) -> None:
    """With a time limit and without; the counts are exact, so one more object is noticed here."""
    command = [sys.executable, str(SCRIPT), "--json", *limits]
    # The debug mode of asyncio, in which tests run, makes calls of its own.
    surroundings = {name: value for name, value in os.environ.items() if "DEBUG" not in name}
    ended = subprocess.run(command, capture_output=True, check=True, text=True, env=surroundings)
    found = json.loads(ended.stdout)
    for name, agreed in MOST.items():
        for what, most in agreed.items():
            assert found[name][what] <= most, (name, what, found[name])
