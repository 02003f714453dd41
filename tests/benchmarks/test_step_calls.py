"""How many Python calls a step makes on the trainer's side: no more than was agreed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from run_python import output_of

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
    # The debug mode of asyncio, in which tests run, makes calls of its own.
    found = json.loads(output_of(SCRIPT, "--json", *limits, asyncio_debug=False))
    for name, agreed in MOST.items():
        for what, most in agreed.items():
            assert found[name][what] <= most, (name, what, found[name])
