"""Every benchmark runs and tells what it is asked for; how fast is nobody's business here."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from run_python import output_of

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
ONE_STAGE = Path(__file__).with_name("one_stage.py")

# Of each script the contenders that take part, by parts of their names; all if there are none.
ASKED = {
    "cheetah": ["rlightning_aio async"],
    "adapters": ["rlightning_aio VectorEnv", "sb3.VecEnv"],
    "batches": [
        "aio, HalfCheetah x 32",
        "aio, 16 of HalfCheetah",
        "make_vec, H",
        "bare mujoco.batch, Ant",
    ],
    "cartpole": ["rlightning_aio sync", "loop"],
    "humanoid": ["rlightning_aio sync"],
    "round_trip": [],
    "facade": [],
    "trainer_cpu": ["sync, 8 envs", "batches of 8, 8 envs"],
    "stragglers": ["rlightning_aio async"],
    "uneven": ["log-normal sleeps, 4", "asyncio, all work 50 µs", "5 µs"],
    "start": [],
    "memory": ["rlightning_aio"],
    "pong": ["rlightning_aio"],
    "tracing": ["async half, CartPole"],
    "filming": ["compute"],
    "thread_share": ["HalfCheetah x 32", "envs x 256"],
    "loop_pause": [],
    "headline": ["make_vec"],
    "exchange": ["sync", "bare exchange"],
    "awaitable": ["loop, 1,000", "gather", "thread"],
    "peers": ["Gymnasium", "SB3", "Tianshou", "EnvPool, 16 of 32", "TorchRL", "PufferLib"],
}
# Here the work itself gives the length.
WITHOUT_SECONDS = ("start", "memory")
TOGETHER = (
    (
        "cheetah",
        "batches",
        "cartpole",
        "humanoid",
        "start",
        "memory",
        "tracing",
        "filming",
        "thread_share",
        "loop_pause",
        "headline",
        "exchange",
        "awaitable",
    ),
    ("round_trip", "facade", "trainer_cpu", "stragglers", "uneven", "peers", "pong", "adapters"),
)
RARELY_SLOW = "all work 50 µs, 2 of 8 rarely take 100 ms, 4 to a worker"


def imported(script: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a script as a module."""
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    return importlib.import_module(script)


def short_round(script: str, folder: Path) -> list[str]:
    """A script and its arguments for one round, which writes its report into the folder."""
    only = [argument for part in ASKED[script] for argument in ("--only", part)]
    seconds = [] if script in WITHOUT_SECONDS else ["--seconds", "0.05"]
    return [script, "--rounds", "1", *seconds, "--json", str(folder / f"{script}.json"), *only]


def test_context_switches_of_all_processes(tmp_path: Path) -> None:
    """Trainer and workers wait for each other in each batch, which takes at least one switch."""
    only = ("--only", "rlightning_aio sync", "--only", "bare exchange")
    path = tmp_path / "exchange.json"
    arguments = ("--rounds", "1", "--seconds", "0.2", "--json", str(path), *only)
    output_of(BENCHMARKS / "exchange.py", *arguments, folder=tmp_path)
    report = json.loads(path.read_text())
    assert "context switches/batch" in report["tables"]
    assert all(found["switches_per_batch"] > 1 for found in report["results"].values())


def test_a_script_run_by_itself(tmp_path: Path) -> None:
    """Contenders have processes of their own then, and their figures come from there."""
    script, *arguments = short_round("cartpole", tmp_path)
    output_of(BENCHMARKS / f"{script}.py", *arguments, folder=tmp_path)
    report = json.loads((tmp_path / "cartpole.json").read_text())
    assert report["results"].keys() == {"rlightning_aio sync", "in-process loop"}
    assert all(found["median"] > 0 for found in report["results"].values())
    assert all(found["cores_used"] > 0 for found in report["results"].values())


CONTENDERS = {
    "cheetah": 1,
    "batches": 4,
    "cartpole": 2,
    "humanoid": 1,
    "round_trip": 4,
    "facade": 2,
    "trainer_cpu": 2,
    "stragglers": 1,
    "start": 4,
    "memory": 1,
    "tracing": 2,
    "filming": 2,
    "loop_pause": 2,
    "headline": 1,
    "exchange": 9,
}
PEERS = {
    "Gymnasium AsyncVectorEnv": "gymnasium",
    "Gymnasium SyncVectorEnv": "gymnasium",
    "SB3 SubprocVecEnv": "stable_baselines3",
    "Tianshou ShmemVectorEnv": "tianshou",
    "EnvPool, 16 of 32": "envpool",
    "TorchRL ParallelEnv": "torchrl",
    "TorchRL AsyncEnvPool, all": "torchrl",
    "TorchRL AsyncEnvPool, 16 of 32": "torchrl",
    "PufferLib, synchronous": "pufferlib",
    "PufferLib, 16 of 32": "pufferlib",
}


def check_peers(report: dict[str, Any]) -> None:
    """Each peer that is installed was measured."""
    for peer, module in PEERS.items():
        if importlib.util.find_spec(module) is not None:
            assert report["results"][peer]["median"] > 0


def check_uneven(report: dict[str, Any]) -> None:
    """Each number of results has its latenesses, of both drivers and of the bare pipe; results of
    the calm turns between rare slow steps are not among them. Even step times have rates.
    """
    assert not report["skipped"]
    rows = [row for row in report["lateness"] if row["mixture"] != RARELY_SLOW]
    assert [row["min_results"] for row in rows] == [1, 4, 6]
    for row in rows:
        for who in ("asyncio", "blocking", "bare pipe"):
            assert row[who]["count"] > 0
            assert 0 <= row[who]["median"] <= row[who]["p99"] <= row[who]["worst"]
        assert row["mixture"] in report["tables"]
    rows = [row for row in report["lateness"] if row["mixture"] == RARELY_SLOW]
    assert len(rows) == 3
    assert all(0 < row["asyncio"]["count"] <= 8 for row in rows)
    assert len(report["rates"]) == 3
    assert all(found["median"] > 0 for found in report["rates"].values())


def check_adapters(report: dict[str, Any]) -> None:
    """Each interface steps, where the library that it belongs to is installed."""
    name = "rlightning_aio VectorEnv"
    own = ("8 that sleep 10 ms", "32 that compute 1 ms", "32 that compute 1 ms, by core")
    asked = {name, *(f"{name}, {envs}" for envs in own)}
    if importlib.util.find_spec("stable_baselines3") is not None:
        asked.add("rlightning_aio sb3.VecEnv")
    assert report["results"].keys() == asked


def check_pong(report: dict[str, Any]) -> None:
    """Raw frames pass through the synchronous and the asynchronous group."""
    if importlib.util.find_spec("ale_py") is not None:
        assert len(report["results"]) == 2


def check_thread_share(report: dict[str, Any]) -> None:
    """The trainer's thread is busy in a step, and more cores make the model faster."""
    found = report["results"]["make_vec, HalfCheetah x 32"]
    assert found["outside_us"] > 0
    assert "model, not measured" in report["tables"]
    assert "awaitable envs x 256 |" in report["tables"]


def check_awaitable(report: dict[str, Any]) -> None:
    """Each way steps its envs, and what has a target is compared with it."""
    assert len(report["results"]) == 3
    for found in report["results"].values():
        assert found["trainer, µs/step"]["median"] > 0
    assert "≥ 0.95" in report["tables"]


CHECKS = {
    "peers": check_peers,
    "uneven": check_uneven,
    "adapters": check_adapters,
    "pong": check_pong,
    "awaitable": check_awaitable,
    "thread_share": check_thread_share,
}


# In few tests, because each starts a process: the processes of pytest would repeat a fixture.
@pytest.mark.parametrize("scripts", TOGETHER, ids=lambda scripts: f"{scripts[0]} and others")
def test_each_script_measures_its_contenders(scripts: tuple[str, ...], tmp_path: Path) -> None:
    """A short round ends with a positive figure for every contender that was asked for."""
    rounds = [short_round(script, tmp_path) for script in scripts]
    output_of(ONE_STAGE, json.dumps(rounds), folder=tmp_path)
    for script in scripts:
        report = json.loads((tmp_path / f"{script}.json").read_text())
        if script in CHECKS:
            CHECKS[script](report)
        if script in CONTENDERS:
            assert not report["skipped"], script
            assert len(report["results"]) == CONTENDERS[script], script
        if script in CONTENDERS and script != "facade":  # Both of its sides are alike.
            assert all(found["median"] > 0 for found in report["results"].values()), script


def test_lateness_is_measured_from_the_kth_of_all_outstanding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A result that was ready and left over counts as ready, whoever is handed out instead."""
    calls = imported("uneven", monkeypatch).Calls()
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


def test_every_script_has_its_place_in_the_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `run_all` runs is what the page of all tables has room for."""
    run_all = imported("run_all", monkeypatch)
    marked = re.findall(r"^<!-- (\w+) -->$", (BENCHMARKS / "tables.md").read_text(), re.MULTILINE)
    assert sorted(set(marked) - {"end"}) == sorted((*run_all.SCRIPTS, *run_all.LONG))


def test_the_picture_shows_the_kept_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who renews results by hand runs benchmarks/picture.py."""
    picture = imported("picture", monkeypatch)
    assert picture.PICTURE.read_text() == picture.drawn(picture.RESULTS)


def test_a_renewed_table_stands_between_its_marks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A table replaces the old one of the same name and nothing else."""
    run_all = imported("run_all", monkeypatch)
    monkeypatch.setattr(run_all, "RESULTS", tmp_path)
    machine: dict[str, Any] = {
        "cores": 2, "cpu": "a CPU", "memory_gib": 4, "system": "Linux", "python": "3.11",
        "versions": {},
    }  # fmt: skip
    report: dict[str, Any] = {
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


def test_what_keeping_states_costs_is_told(tmp_path: Path) -> None:
    """Beside the same without, for each number of steps."""
    where = ["--backend", "gymnasium", "--task", "CartPole-v1", "--envs", "2", "--every", "3"]
    # Processor time comes in hundredths of a second: fewer steps could take none at all.
    program = [BENCHMARKS / "keeping.py", *where, "--steps", "1000", "--rounds", "1", "--json"]
    told = json.loads(output_of(*program, folder=tmp_path))
    assert told.keys() == {"never", "3"}
    assert told["never"]["ratio"] == 1
