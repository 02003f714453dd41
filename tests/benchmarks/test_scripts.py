"""Every benchmark runs and tells what it is asked for; how fast is nobody's business here."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from patience import HANG

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def run_script(name: str, folder: Path, *arguments: str) -> dict[str, Any]:
    """The report of one short round."""
    out = folder / f"{name}.json"
    run = subprocess.run(
        [sys.executable, BENCHMARKS / f"{name}.py", "--rounds", "1", "--json", out, *arguments],
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(out.read_text())


SHORT = ("--seconds", "0.05")
OURS = ("--only", "rlightning_aio")


@pytest.mark.parametrize(
    ("name", "arguments", "contenders"),
    [
        ("cheetah", (*SHORT, "--only", "rlightning_aio async", "--only", "limit"), 2),
        ("cartpole", (*SHORT, "--only", "rlightning_aio sync", "--only", "loop"), 2),
        ("humanoid", (*SHORT, "--only", "rlightning_aio sync"), 1),
        ("round_trip", SHORT, 4),
        ("facade", SHORT, 2),
        ("trainer_cpu", (*SHORT, "--only", ", 8 envs"), 3),
        ("stragglers", (*SHORT, "--only", "rlightning_aio async", "--only", "64 proc"), 2),
        ("start", (), 2),
        ("memory", OURS, 1),
    ],
)
def test_script_measures_each_of_its_contenders(
    name: str, arguments: tuple[str, ...], contenders: int, tmp_path: Path
) -> None:
    """A short run ends with a positive figure for every contender that was asked for."""
    report = run_script(name, tmp_path, *arguments)
    assert not report["skipped"]
    assert len(report["results"]) == contenders
    if name != "facade":  # Both of its sides are alike.
        assert all(found["median"] > 0 for found in report["results"].values())


@pytest.mark.parametrize(
    ("module", "peer"),
    [
        ("gymnasium", "Gymnasium AsyncVectorEnv"),
        ("gymnasium", "Gymnasium SyncVectorEnv"),
        ("stable_baselines3", "SB3 SubprocVecEnv"),
        ("tianshou", "Tianshou ShmemVectorEnv"),
        ("envpool", "EnvPool, 16 of 32"),
    ],
)
def test_peer_steps(module: str, peer: str, tmp_path: Path) -> None:
    """Each peer that is installed can be measured."""
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    report = run_script("peers", tmp_path, *SHORT, "--only", peer)
    assert report["results"][peer]["median"] > 0


def test_uneven_tells_how_late_each_driver_collects(tmp_path: Path) -> None:
    """Each number of results has its latenesses, of both drivers and of the bare pipe."""
    report = run_script("uneven", tmp_path, *SHORT, "--only", "log-normal sleeps, 4")
    assert not report["skipped"]
    assert [row["min_results"] for row in report["lateness"]] == [1, 4, 6]
    for row in report["lateness"]:
        for who in ("asyncio", "blocking", "bare pipe"):
            assert row[who]["count"] > 0
            assert 0 <= row[who]["median"] <= row[who]["p99"] <= row[who]["worst"]
        assert row["mixture"] in report["tables"]


def test_uneven_counts_turns_with_a_rare_slow_step(tmp_path: Path) -> None:
    """What is collected in the calm turns between is not among the latenesses."""
    report = run_script("uneven", tmp_path, *SHORT, "--only", "asyncio, all work 50 µs")
    counts = [row["asyncio"]["count"] for row in report["lateness"]]
    assert all(0 < count <= 8 for count in counts)


def test_uneven_tells_the_rate_at_even_step_times(tmp_path: Path) -> None:
    """Both drivers and the bare loops have a rate."""
    report = run_script("uneven", tmp_path, *SHORT, "--only", "5 µs")
    assert len(report["rates"]) == 3
    assert all(found["median"] > 0 for found in report["rates"].values())


def test_lateness_is_measured_from_the_kth_of_all_outstanding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A result that was ready and left over counts as ready, whoever is handed out instead."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    calls = importlib.import_module("uneven").Calls()
    now = iter([1.0, 5.0, 6.0, 7.0])
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    calls.sent(range(3))
    for wanted, envs, done in ((2, [0, 2], [2.0, 4.0]), (1, [1], [3.0])):
        collect = calls.collect(wanted)
        assert next(collect) == wanted
        with pytest.raises(StopIteration):
            collect.send("a batch")
        calls.came(envs, done)
    # Called at 1, the second of 2, 3 and 4 was ready at 3; the next at once, called at 6.
    assert calls.late_ms() == [2000.0, 1000.0]


def test_pong(tmp_path: Path) -> None:
    """Raw frames pass through the synchronous and the asynchronous group."""
    if importlib.util.find_spec("ale_py") is None:
        pytest.skip("ale_py is not installed")
    report = run_script("pong", tmp_path, *SHORT, *OURS)
    assert len(report["results"]) == 2


def test_every_script_has_its_place_in_the_readme(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `run_all` runs is what the README has tables for."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    run_all = importlib.import_module("run_all")
    marked = re.findall(r"^<!-- (\w+) -->$", (BENCHMARKS / "README.md").read_text(), re.MULTILINE)
    assert sorted(set(marked) - {"end"}) == sorted(run_all.SCRIPTS)


def test_a_renewed_table_stands_between_its_marks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A table replaces the old one of the same name and nothing else."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    run_all = importlib.import_module("run_all")
    monkeypatch.setattr(run_all, "RESULTS", tmp_path)
    machine = {
        "cores": 2, "cpu": "a CPU", "memory_gib": 4, "system": "Linux", "python": "3.11",
        "versions": {},
    }  # fmt: skip
    report = {
        "title": "T", "unit": "s", "rounds": 3, "machine": machine, "targets": [], "skipped": {},
        "results": {"A": {"median": 1.0, "low": 0.5, "high": 2.0}},
    }  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(report))
    text = "<!-- a -->\nold\n<!-- end -->\n<!-- b -->\nkept\n<!-- end -->\n"
    renewed = run_all.with_table(text, "a")
    assert "| A | 1 | 0.5 to 2 |" in renewed
    assert "old" not in renewed
    assert renewed.endswith("<!-- b -->\nkept\n<!-- end -->\n")
    assert run_all.with_table(renewed, "a") == renewed
