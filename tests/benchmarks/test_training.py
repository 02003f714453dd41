"""What is asked of those that train: one short turn, and how figures are held against targets."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import pytest
from run_python import output_of

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def turn(wall: float, learner: float = 0.0, returned: float = 0.0) -> dict[str, float]:
    return {"wall": wall, "outside": wall - learner, "return": returned}


@pytest.mark.parametrize(
    ("target", "values", "met"),
    [
        # The better baseline is another one in each seed.
        (("ours", "wall", "the better baseline", 0.5), [0.5, 0.4, 1.0], True),
        (("ours", "wall", "the better baseline", 0.5, True, True), [0.5, 0.4, 1.0], False),
        (("ours", "wall", "AsyncVectorEnv", 0.3), [0.5, 0.2, 0.25], True),
        (("ours", "outside", "", 4.0), [4.0, 3.0, 4.0], True),
        (("ours", "return", "the baselines' spread", 0.0, False), [20.0], True),
    ],
)
def test_targets_are_held_seed_by_seed(
    target: Any, values: list[float], met: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A figure is divided by that of the same seed; its median counts, or every one."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    training = importlib.import_module("training")
    found = {
        "AsyncVectorEnv": [turn(10, 0, 15), turn(20, 0, 30), turn(20, 0, 20)],
        "SyncVectorEnv": [turn(12, 0, 15), turn(10, 0, 25), turn(5, 0, 20)],
        "ours": [turn(5, 1, 10), turn(4, 1, 20), turn(5, 1, 30)],
    }
    judged = training.judged(training.Target(*target), found)
    assert judged["values"] == pytest.approx(values)
    assert judged["met"] == met
    assert training.judged(training.Target("absent", *target[1:]), found) is None


@pytest.mark.simulators
def test_turns_are_kept(tmp_path: Path) -> None:
    """A contender and the baseline train; a second run tells the same turns, and runs none."""
    pytest.importorskip("torch")
    report, kept = tmp_path / "report.json", tmp_path / "turns"
    asked = ["--only", "cartpole/ppo_async", "--only", "cartpole/SyncVectorEnv"]
    command = [BENCHMARKS / "training.py", *asked, "--seeds", "1", "--steps", "1024"]
    command += ["--folder", kept, "--json", report]
    printed = output_of(*command, asyncio_debug=False)
    assert "| ppo_async, inline |" in printed
    found = json.loads(report.read_text())["workloads"]["cartpole"]
    assert found["results"].keys() == {"SyncVectorEnv", "ppo_async, inline"}
    for (brought,) in found["results"].values():
        assert 0 < brought["outside"] == brought["wall"] - brought["learner"]
        assert brought["return"] > 0
        assert brought["curve"]
    before = {path: path.stat().st_mtime_ns for path in kept.rglob("*")}
    assert output_of(*command, asyncio_debug=False) == printed
    assert {path: path.stat().st_mtime_ns for path in kept.rglob("*")} == before


@pytest.mark.simulators
@pytest.mark.parametrize("kind", ["make_vec", "EnvPool"])
def test_envs_that_are_stepped_together_learn_in_the_baselines_loop(
    kind: str, tmp_path: Path
) -> None:
    for module in ("torch", "envpool"):
        pytest.importorskip(module)
    report, asked = tmp_path / "report.json", ["--only", f"pool/{kind}", "--seeds", "1"]
    kept = ["--folder", tmp_path / "turns", "--json", report]
    output_of(BENCHMARKS / "training.py", *asked, "--steps", "1024", *kept, asyncio_debug=False)
    (found,) = json.loads(report.read_text())["workloads"]["pool"]["results"][kind]
    assert 0 < found["outside"] == found["wall"] - found["learner"]
