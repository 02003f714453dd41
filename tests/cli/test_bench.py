"""``bench`` compares settings, in a process of its own."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, line_with, run, start, write_config
from patience import HANG

from rlightning_aio import EnvConfig, load_config
from rlightning_aio.cli import baselines, bench, settings

STUB = {"name": "stub", "backend": "stub", "task": "any", "num_workers": 4}
QUICK = ["--seconds", 0.01, "--rounds", 2]


def without_child(work: Any) -> None:
    work(lambda _words: None)


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fix the number of cores, on which the settings depend; let `invoke` measure in this process,
    whose threads a fork would stop.
    """
    monkeypatch.setattr(settings, "num_cores", lambda: 2)
    monkeypatch.setattr(bench, "_run_in_child", without_child)


def settings_of(contenders: list[dict[str, Any]]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((c["placement"], c["workers"]) for c in contenders))


def test_bench_measures_every_place_under_every_rule(tmp_path: Path) -> None:
    """Each has the given number of rounds."""
    document = invoke_json("bench", write_config(tmp_path, STUB), *QUICK)
    contenders = document["contenders"]
    assert settings_of(contenders) == [
        ("process", 1),
        ("process", 2),
        ("process", 4),
        ("inline", 0),
    ]
    rules = [None, 1, 2, 4]
    assert [c["min_results"] for c in contenders] == rules * 4
    assert all(len(c["rounds"]) == 2 and min(c["rounds"]) > 0 for c in contenders)
    assert all(c["latency_us"]["p50"] <= c["latency_us"]["p99"] for c in contenders)
    assert document["best"] in contenders
    assert document["versions"]["gymnasium"]
    assert (document["interrupted"], document["cores"] > 0) == (False, True)


def test_bench_prints_a_table(tmp_path: Path) -> None:
    """The table has a line for each contender, with its place and rule."""
    config = write_config(tmp_path, {**STUB, "num_workers": 1})
    done = invoke("bench", config, *QUICK)
    lines = done.stdout.splitlines()[1:]
    rows = [line for line in lines if ("async" in line or "step " in line) and ";" not in line]
    assert [row.split("  ")[0] for row in rows[:4]] == ["1 worker process"] * 2 + ["inline"] * 2


def test_bench_measures_entries_with_different_spaces_together(tmp_path: Path) -> None:
    """Such a group is also stepped synchronously."""
    stub = {**STUB, "num_workers": 2}
    other = {**stub, "name": "other", "env_kwargs": {"actions": 5, "observation_size": 3}}
    document = invoke_json("bench", write_config(tmp_path, stub, other), *QUICK)
    assert all(c["steps_per_second"] > 0 for c in document["contenders"])
    assert document["contenders"][0]["envs_per_process"] == {"stub": 2, "other": 2}


def test_a_setting_that_cannot_start_is_reported_and_the_others_are_measured(
    tmp_path: Path,
) -> None:
    """One reason is an env that can't live in the trainer's process."""
    entry = {**STUB, "backend": "worker_only", "num_workers": 2}
    done = invoke("bench", write_config(tmp_path, entry), *QUICK)
    assert done.exit_code == 0
    assert "inline: env 'stub-0'" in done.stdout
    assert "needs a process of its own" in done.stdout


def test_an_interrupted_bench_prints_its_results_so_far(tmp_path: Path) -> None:
    """Ctrl-C ends it after the present measurement."""
    with start("bench", write_config(tmp_path, CARTPOLE), "--rounds", 10**6, "--json") as child:
        line_with(child, "measuring")
        child.send_signal(signal.SIGINT)
        stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130
    assert "Traceback" not in stderr
    if stdout:
        document = json.loads(stdout)
        assert (document["interrupted"], bool(document["contenders"])) == (True, True)


def test_a_plot_without_matplotlib_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message has the install command."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name)
    )
    done = invoke("bench", write_config(tmp_path, STUB), "--plot", tmp_path / "plot.png")
    assert done.exit_code == 2
    assert "pip install matplotlib" in done.stderr


def test_the_plot_is_an_image(tmp_path: Path) -> None:
    """--plot writes a PNG."""
    if importlib.util.find_spec("matplotlib") is None:
        pytest.skip("matplotlib is not installed")
    path = tmp_path / "plot.png"
    # In a process of its own, because matplotlib keeps its fonts open.
    done = run("bench", write_config(tmp_path, CARTPOLE), *QUICK, "--plot", path)
    assert done.returncode == 0, done.stderr
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_sweep_measures_all_combinations_and_nothing_else(tmp_path: Path) -> None:
    """A field is that of all entries, or of the one that is named; the rules may be swept, too."""
    config = write_config(tmp_path, STUB, {**CARTPOLE, "num_workers": 2})
    sweeps = ["placement=process,inline", "envs.0.num_workers=1", "min_results=4,2"]
    sweeps += ["envs.0.num_workers=3"]
    words = [word for sweep in sweeps for word in ("--sweep", sweep)]
    contenders = invoke_json("bench", config, *QUICK, *words)["contenders"]
    assert [(c["placement"], c["num_workers"], c["min_results"]) for c in contenders] == [
        (placement, {"stub": count, "pole": 2}, least)
        for placement in ("process", "inline")
        for count in (1, 3)
        for least in (2, 4)
    ]
    assert {c["workers"] for c in contenders if c["placement"] == "inline"} == {0}
    assert "placement=inline, envs.0.num_workers=3" in {c["place"] for c in contenders}


def entry(**fields: Any) -> EnvConfig:
    return EnvConfig(**{"name": "a", "backend": "gymnasium", "task": "CartPole-v1", **fields})


def found(*entries: EnvConfig) -> list[tuple[str, int, list[tuple[int, int]]]]:
    """Return the settings: placement, workers, and the numbers of envs and sub-environments."""
    return [
        (s.placement, s.workers, [(c.num_workers, c.num_envs) for c in s.configs])
        for s in settings.possible_settings(entries)
    ]


@pytest.mark.parametrize(
    ("fields", "workers"),
    [
        ({"num_workers": 1}, [1, 0]),
        ({"num_workers": 3}, [1, 2, 3, 0]),
        ({"num_workers": 64}, [1, 2, 4, 32, 0]),
        # A simulator that uses threads or a device needs a process for each env.
        ({"num_workers": 3, "backend": "maniskill"}, [3, 0]),
        # Fields that need a worker exclude this process.
        ({"num_workers": 2, "env_vars": {"A": "1"}}, [1, 2]),
        ({"num_workers": 2, "interpreter": "/usr/bin/python3"}, [1, 2]),
    ],
)
def test_numbers_of_workers_to_try(fields: dict[str, Any], workers: list[int]) -> None:
    """They go from one to one for each env, up to a limit; this process is tried if possible."""
    sizes = [(fields["num_workers"], 1)]
    tried = [(where, count) for where, count, own in found(entry(**fields)) if own == sizes]
    assert [count for _, count in tried] == workers
    assert [where for where, count in tried if count == 0] == ["inline"] * workers.count(0)


@pytest.mark.parametrize(
    ("fields", "tried"),
    [
        ([{}], [("loop", 0), ("process", 1), ("process", 2), ("process", 4)]),
        # Workers have no such limit.
        ([{"max_concurrency": 2}], [("loop", 0)]),
        # Envs that are not awaitable need workers.
        ([{}, {"placement": "process"}], [("process", 2), ("process", 4), ("process", 8)]),
    ],
    ids=["alone", "limited", "beside others"],
)
def test_awaitable_envs_are_tried_on_the_event_loop_and_in_workers(
    fields: list[dict[str, Any]], tried: list[tuple[str, int]]
) -> None:
    talk = {"task": "cli.stub_envs:Talk", "placement": "loop", "num_workers": 4}
    entries = [EnvConfig(**{"name": f"t{k}", **talk, **own}) for k, own in enumerate(fields)]
    assert [(where, count) for where, count, _ in found(*entries)] == tried


def test_simulations_that_can_share_an_env_are_also_tried_that_way() -> None:
    """CartPole-v1 can, because it has a vector entry point."""
    tried = found(entry(num_workers=8))
    eight, four, one = [(8, 1)], [(2, 4)], [(1, 8)]
    assert {"inline", "process"} == {where for where, _, own in tried if own == eight}
    assert ("inline", 0, one) in tried
    assert ("process", 1, one) in tried
    assert ("process", 2, four) in tried
    # In any configuration, also together with entries that can't do this.
    assert found(entry(num_envs=8))[:1] == [("process", 1, one)]
    assert ("process", 2, four) in found(entry(num_envs=8))
    other = entry(name="b", backend="callable", task="module:make", num_workers=3)
    assert ("inline", 0, [(1, 8), (3, 1)]) in found(entry(num_workers=8), other)


def test_the_first_line_says_the_fastest_setting(tmp_path: Path) -> None:
    """As overrides of the config, beside the fastest baseline; without one, alone."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2})
    done = run("bench", config, *QUICK)
    assert done.returncode == 0, done.stderr
    first, *_ = done.stdout.splitlines()
    found = re.fullmatch(
        r"Fastest: (envs\.0\..+), (step|collect_async)\(.+\): [\d.e+]+ times as many steps/s as .+",
        first,
    )
    assert found is not None, first
    (chosen,) = load_config(config, found[1].split(" "))
    assert chosen.num_workers * chosen.num_envs == 2
    first, *_ = invoke("bench", config, *QUICK, "--sweep", "placement=inline").stdout.splitlines()
    assert first.startswith("Fastest: envs.0.placement=inline envs.0.num_workers=2 ")
    assert first.endswith(")")


def test_a_sweep_may_be_of_a_field_of_env_kwargs(tmp_path: Path) -> None:
    """It is that of all entries, too."""
    config = write_config(tmp_path, {**STUB, "env_kwargs": {"actions": 2}}, {**STUB, "name": "b"})
    sweep = ("--sweep", "env_kwargs.observation_size=1,3", "--sweep", "min_results=1")
    contenders = invoke_json("bench", config, *QUICK, *sweep)["contenders"]
    assert [c["place"] for c in contenders] == [
        "env_kwargs.observation_size=1", "env_kwargs.observation_size=3"
    ]  # fmt: skip


async def test_baselines_are_made_without_arguments_of_ours() -> None:
    kwargs = {"num_threads": 1, "record_video": {"folder": "films"}}
    config = entry(backend="mujoco", task="InvertedPendulum-v5", env_kwargs=kwargs)
    for baseline in baselines.baselines_of([config])[:2]:
        async with baseline.opened(None):
            pass


def test_one_place_is_open_at_a_time(tmp_path: Path) -> None:
    """An env may be the only one that can be there."""
    lock = {"name": "a", "task": "cli.stub_envs:Exclusive", "env_kwargs": {"folder": str(tmp_path)}}
    document = invoke_json("bench", write_config(tmp_path, lock), *QUICK)
    assert [c["failure"] for c in document["contenders"]] == [None] * len(document["contenders"])


@pytest.mark.parametrize("where", ["info", "observation"])
def test_actions_obey_masks(tmp_path: Path, where: str) -> None:
    """Those of the newest results, also of baselines."""
    masked = {**MASKED, "env_kwargs": {"where": where}}
    done = run("bench", write_config(tmp_path, masked), *QUICK, "--json")
    assert done.returncode == 0, done.stderr
    contenders = json.loads(done.stdout)["contenders"]
    assert {c["place"] for c in contenders} >= {"bare loop", "SyncVectorEnv", "AsyncVectorEnv"}
    assert [c["failure"] for c in contenders] == [None] * len(contenders)


MASKED = {"name": "m", "backend": "gymnasium", "task": "cli/Masked-v0", "num_workers": 2}

ENDS = {
    0: "exited with code 0",
    7: "exited with code 7",
    -signal.SIGSEGV: "was killed by SIGSEGV",
}
"""Exit statuses of an env's process, and words for them."""


@pytest.mark.parametrize("status", ENDS)
def test_an_env_that_ends_the_process_ends_the_bench(tmp_path: Path, status: int) -> None:
    """The message says which contender was measured."""
    entry = {"name": "dying", "backend": "dying", "task": "any", "env_kwargs": {"status": status}}
    done = run("bench", write_config(tmp_path, entry), "--rounds", 1, "--seconds", 0.05)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines()[-1] == (
        f"error: inline, step: the process that stepped the envs {ENDS[status]}, so there is no "
        "table"
    )
    assert "Traceback" not in done.stderr


def test_no_env_is_blamed_where_nobody_reads_the_table(tmp_path: Path) -> None:
    """As in ``bench … | true``."""
    config = write_config(tmp_path, CARTPOLE)
    words = ("bench", config, "--sweep", "placement=inline", "--rounds", 1, "--seconds", 0.01)
    with start(*words) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        stderr = child.stderr.read()
    assert child.returncode == 1
    assert "error" not in stderr
    assert "Traceback" not in stderr


def test_workers_that_were_replaced_are_counted(tmp_path: Path) -> None:
    """Below the table."""
    entry = {"name": "dying", "backend": "dying", "task": "any", "max_restarts": 10**6}
    words = ("--rounds", 1, "--seconds", 0.05, "--sweep", "num_workers=1")
    done = run("bench", write_config(tmp_path, entry), *words)
    assert done.returncode == 0, done.stderr
    counted = "^num_workers=1: \\d+ restarts? of a worker that died$"
    assert re.search(counted, done.stdout, re.MULTILINE)


def test_without_any_measurement_the_exit_code_is_1(tmp_path: Path) -> None:
    """The message is the cause."""
    entry = {"name": "a", "backend": "raising", "task": "any"}
    done = run("bench", write_config(tmp_path, entry), "--rounds", 1, "--seconds", 0.05)
    assert (done.returncode, done.stdout) == (1, "")
    assert "ZeroDivisionError: the floor is missing" in done.stderr.splitlines()[-1]
    assert done.stderr.splitlines()[-1].startswith("error: ")


def test_an_interrupted_bench_leaves_no_process(tmp_path: Path) -> None:
    """Neither a worker nor the process of an env that hangs outside of workers."""
    pid_file = tmp_path / "pid"
    os.mkfifo(pid_file)
    hangs = {"pid_file": str(pid_file), "where": "step", "only": "inline"}
    entry = {**STUB, "backend": "stuck", "num_workers": 1, "env_kwargs": hangs}
    config = write_config(tmp_path, entry)
    with start("bench", config) as child:
        stepper = int(pid_file.read_text())
        for _ in range(2):  # An env that keeps the event loop needs a second one.
            child.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(HANG / 100)
        stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130, stderr
    assert "Traceback" not in stderr
    assert "Interrupted: " in stdout
    assert not Path(f"/proc/{stepper}").exists()
