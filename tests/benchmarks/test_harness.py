"""The harness: turns, pairs, and contenders that are missing or break."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from patience import HANG

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

SCRIPT = '''
from dataclasses import dataclass
from harness import Contender, Question, Target, main

@dataclass
class Scripted(Contender):
    """Returns what it was given, and notes its turns."""
    name: str
    values: list
    turns: str

    def round(self, seconds):
        with open(self.turns, "a") as turns:
            turns.write(self.name[0])
        return self.values.pop(0)

@dataclass
class Absent(Scripted):
    @property
    def requires(self):
        return ("no_such_module_anywhere",)

@dataclass
class Broken(Scripted):
    def setup(self):
        raise LookupError("nothing here")

@dataclass
class Dies(Scripted):
    def round(self, seconds):
        import os
        os._exit(7)

if __name__ == "__main__":
    import sys
    turns = sys.argv.pop()
    ours = Scripted("ours", [10.0, 30.0, 12.0], turns)
    peer = Scripted("peer", [5.0, 10.0, 4.0], turns)
    others = [cls(cls.__name__, [], turns) for cls in (Absent, Broken, Dies)]
    question = Question(
        "toy", "A toy", "things/s", [ours, *others, peer],
        [Target("ours", "peer", 2.5), Target("ours", "peer", 2.0, True),
         Target("ours", "Absent", 1.0)],
        reference="peer", rounds=3,
    )
    main([question], None)
'''


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The report of one run of the script, with what was printed and the turns."""
    folder = tmp_path_factory.mktemp("toy")
    script, turns, out = folder / "toy.py", folder / "turns", folder / "toy.json"
    script.write_text(SCRIPT)
    run = subprocess.run(
        [sys.executable, script, "--seconds", "0.01", "--json", out, turns],
        env={**os.environ, "PYTHONPATH": str(BENCHMARKS)},
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return {**json.loads(out.read_text()), "turns": turns.read_text(), "printed": run.stdout}


def test_contenders_take_turns(report: dict[str, Any]) -> None:
    """Every round has one turn of each contender, in the same order."""
    assert report["turns"] == "opopop"


def test_medians_and_multiples(report: dict[str, Any]) -> None:
    """A contender's figure is the median of its rounds, and a multiple that of their ratios."""
    assert report["results"]["ours"] == {
        "median": 12.0, "low": 10.0, "high": 30.0, "values": [10.0, 30.0, 12.0],
        "times": {"median": 3.0, "low": 2.0, "high": 3.0, "values": [2.0, 3.0, 3.0]},
    }  # fmt: skip


def test_targets_are_held_against_the_ratios_of_rounds(report: dict[str, Any]) -> None:
    """Their median counts, not the ratio of medians."""
    least, most = report["targets"]
    assert least["values"] == most["values"] == [2.0, 3.0, 3.0]
    assert least["met"]
    assert not most["met"]


def test_who_cant_run_is_named_with_the_reason(report: dict[str, Any]) -> None:
    """A contender that is missing or breaks is left out and the run goes on without it."""
    assert report["skipped"] == {
        "Absent": "needs no_such_module_anywhere",
        "Broken": "failed: LookupError: nothing here",
        "Dies": "failed: its process ended with 7",
    }


def test_the_table_holds_every_result_and_target(report: dict[str, Any]) -> None:
    """What is printed names each contender, each comparison, and the machine."""
    printed = report["printed"]
    assert "| ours | 12 | 10 to 30 | 3 (2 to 3) |" in printed
    assert "| ours / peer | 3 | 2 to 3 | ≥ 2.5 | met |" in printed
    assert "| ours / peer | 3 | 2 to 3 | ≤ 2 | missed |" in printed
    assert "Absent: needs no_such_module_anywhere" in printed
    assert f"{report['machine']['cores']} cores" in printed
