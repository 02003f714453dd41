"""Runs benchmark scripts in turn, with all contenders in this one process.

For tests that ask what a script tells, not how fast anything is: what a process of each
contender's own costs, a second and more, is left out.

Run as: one_stage.py, then a JSON list of command lines, each a script and its arguments.
"""

from __future__ import annotations

import json
import pickle
import runpy
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import harness  # noqa: E402

if TYPE_CHECKING:
    from harness import Contender


class HereStage:
    """In place of `harness.Stage`; what a contender raises ends the run."""

    def __init__(self, contender: Contender) -> None:
        # A stage of its own gets a copy.
        self.contender: Contender = pickle.loads(pickle.dumps(contender))

    def __enter__(self) -> Self:
        self.contender.setup()
        return self

    def round(self, seconds: float) -> tuple[Any, float]:
        return self.contender.round(seconds), 1.0

    def __exit__(self, *error: object) -> None:
        self.contender.teardown()


if __name__ == "__main__":
    harness.Stage = HereStage
    for script, *arguments in json.loads(sys.argv[1]):
        sys.argv = [script, *arguments]
        runpy.run_path(str(BENCHMARKS / f"{script}.py"), run_name="__main__")
