"""Every benchmark runs and tells what it is asked for; how fast is nobody's business here."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import shutil
import sys
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import pytest
from run_python import output_of

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
ONE_STAGE = Path(__file__).with_name("one_stage.py")
SHORT = ("--rounds", "1", "--seconds", "0.05")
PEERS = {
    "Gymnasium": "gymnasium",
    "SB3": "stable_baselines3",
    "EnvPool": "envpool",
    "TorchRL": "torchrl",
    "rlightning_aio": "rlightning_aio",
}
CAN_RENDER = find_library("EGL") is not None
# By name of the report: a program, its arguments, and parts of the names of those that take part.
ASKED = {
    "cheetah": (["compare", "HalfCheetah-v5", "4"], []),
    "uneven": (
        ["compare", "waiting:benchmarks/Uneven-v0", "4", "--ready", "1", "--envs-per-process", "1"],
        ["group"],
    ),
    "exchange": (["exchange"], ["sync", "bare exchange"]),
    "own_envs": (["own_envs"], ["2 µs, 1 envs", "waits 5 ms, 4"]),
    "awaitable": (["awaitable"], ["loop, 1,000", "gather"]),
    "remote": (["remote"], ["1 client", "64 clients", "224, JPEG" if CAN_RENDER else "none"]),
}


@pytest.fixture
def run_all(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    return importlib.import_module("run_all")


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One short round of each script, all in one process."""
    folder = tmp_path_factory.mktemp("reports")
    commands = [
        [*command, *SHORT, "--json", str(folder / f"{name}.json")]
        + [argument for part in only for argument in ("--only", part)]
        for name, (command, only) in ASKED.items()
    ]
    output_of(ONE_STAGE, json.dumps(commands), folder=folder)
    return {name: json.loads((folder / f"{name}.json").read_text()) for name in ASKED}


def test_each_script_measures_its_contenders(reports: dict[str, Any]) -> None:
    """Every contender that was asked for has a positive figure.

    Each peer that is installed is compared, and only one that isn't is left out.
    """
    counts = {name: len(report["results"]) for name, report in reports.items()}
    assert [counts[name] for name in ("uneven", "exchange", "awaitable", "remote")] == [2, 3, 2, 3]
    assert reports["uneven"]["results"].keys() == {
        "rlightning_aio group, all", "rlightning_aio group, 1 of 4",
    }  # fmt: skip
    compared = reports["cheetah"]["results"]
    assert counts["cheetah"] + len(reports["cheetah"]["skipped"]) == 14
    for name in reports["cheetah"]["skipped"]:
        assert not all(importlib.util.find_spec(module) for module in modules_of(name)), name
    for found in (*compared.values(), *reports["uneven"]["results"].values()):
        assert found["median"] > 0
        assert found["times"]["median"] > 0
    assert reports["cheetah"]["step_timeout"] == 60
    for found in reports["awaitable"]["results"].values():
        assert found["columns"]["trainer, µs/step"]["median"] > 0
    steps, pictures, paced = (found.values() for found in reports["remote"]["results"].values())
    assert [len(steps), len(pictures), len(paced)] == [4, CAN_RENDER, 2]
    for found in (*steps, *pictures, *paced):
        assert all(figures["median"] > 0 for figures in found["columns"].values())
    for name in reports.keys() - {"cheetah", "own_envs"}:
        assert not reports[name]["skipped"]
    for found in reports["own_envs"]["results"].values():
        assert found["named"] == "" or found["promised"] >= 1.5
        assert found["best"] in found["medians"]


def modules_of(contender: str) -> set[str]:
    """Return the modules that a contender of this name needs."""
    return {module for part, module in PEERS.items() if part.lower() in contender.lower()}


def test_a_script_run_by_itself_beside_another_checkout(tmp_path: Path) -> None:
    """Contenders have processes of their own then, and their figures come from there.

    The other checkout's library is the one that is used for its contenders.
    """
    package = tmp_path / "other" / "src" / "rlightning_aio"
    ours = Path(importlib.import_module("rlightning_aio").__file__ or "").parent
    shutil.copytree(ours, package, ignore=shutil.ignore_patterns("__pycache__"))
    with (package / "__init__.py").open("a") as file:
        file.write(f"open({str(tmp_path / 'used')!r}, 'w').close()\n")
    report = tmp_path / "report.json"
    command = ["compare.py", "CartPole-v1", "4", *SHORT, "--beside", tmp_path / "other"]
    more = ["--json", report, "--only", "group, all", "--only", "Gymnasium Sync"]
    output_of(BENCHMARKS / command[0], *command[1:], *more, folder=tmp_path)
    found = json.loads(report.read_text())["results"]
    assert found.keys() == {
        "rlightning_aio group, all", "rlightning_aio group, all, of other",
        "Gymnasium SyncVectorEnv",
    }  # fmt: skip
    assert all(one["median"] > 0 and one["cores_used"] > 0 for one in found.values())
    assert (tmp_path / "used").exists()


def test_every_report_has_its_place(run_all: Any) -> None:
    """What `run_all` runs is what the page of all tables has room for, and what is kept."""
    marked = re.findall(r"^<!-- (\S+) -->$", run_all.TABLES.read_text(), re.MULTILINE)
    assert sorted(set(marked) - {"end"}) == sorted(run_all.RUNS)
    assert {path.stem for path in run_all.RESULTS.glob("*.json")} <= run_all.RUNS.keys()


def test_pages_show_the_kept_results(run_all: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who renews results by hand runs `python benchmarks/run_all.py --pages`."""
    written: dict[Path, str] = {}
    monkeypatch.setattr(Path, "write_text", lambda self, text: written.update({self: text}))
    run_all.renew_pages()
    assert written.keys() == {run_all.TABLES, run_all.PICTURE}
    for path, text in written.items():
        assert path.read_text() == text, path


def test_a_renewed_table_stands_between_its_marks(run_all: Any) -> None:
    """A table replaces the old one of the same name and nothing else."""
    text = "<!-- a -->\nold\n<!-- end -->\n<!-- b -->\nkept\n<!-- end -->\n"
    renewed = run_all.between_marks(text, "a", "new")
    assert renewed == "<!-- a -->\n\nnew\n\n<!-- end -->\n<!-- b -->\nkept\n<!-- end -->\n"
    assert run_all.between_marks(renewed, "a", "new") == renewed
