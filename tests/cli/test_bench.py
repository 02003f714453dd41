"""``bench`` and ``tune``: what they compare, and that what they print can be used."""

from __future__ import annotations

import importlib.util
import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, run, start, write_config
from patience import HANG

from rlightning_aio import EnvConfig, load_config
from rlightning_aio.cli import bench, measuring, tune
from rlightning_aio.config import moved

if TYPE_CHECKING:
    from pathlib import Path

STUB = {"name": "stub", "backend": "stub", "task": "any", "num_workers": 4}
QUICK = ["--seconds", 0.01, "--rounds", 2]


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings tried depend on the machine."""
    monkeypatch.setattr(measuring, "num_cores", lambda: 2)


def settings_of(contenders: list[dict[str, Any]]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((c["placement"], c["workers"]) for c in contenders))


def test_bench_compares_places_and_rules(tmp_path: Path) -> None:
    """Every place meets every rule, in as many rounds as asked for."""
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


def test_a_measurement_has_a_step_however_slow_the_machine_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the time is over with the first batch, and that was of resets, it goes on."""
    monkeypatch.setattr(bench, "Limits", lambda steps, _: measuring.Limits(steps, 0.0))
    config = write_config(tmp_path, {**STUB, "num_workers": 1, "max_episode_steps": 1})
    document = invoke_json("bench", config, "--rounds", 3)
    assert all(min(c["rounds"]) > 0 for c in document["contenders"])


def test_bench_prints_a_table(tmp_path: Path) -> None:
    """One row for each contender, named by place and rule."""
    config = write_config(tmp_path, {**STUB, "num_workers": 1})
    done = invoke("bench", config, *QUICK)
    rows = [line for line in done.stdout.splitlines() if "async" in line or "step " in line]
    assert [row.split("  ")[0] for row in rows] == ["1 worker"] * 2 + ["inline"] * 2


def test_bench_counts_what_entries_with_different_spaces_do_together(tmp_path: Path) -> None:
    """Mixed groups are stepped as one, synchronously too."""
    other = {**STUB, "name": "other", "env_kwargs": {"actions": 5, "observation_size": 3}}
    document = invoke_json("bench", write_config(tmp_path, STUB, other), *QUICK)
    assert all(c["steps_per_second"] > 0 for c in document["contenders"])
    assert document["contenders"][0]["envs_per_process"] == {"stub": 4, "other": 4}


def test_a_setting_that_can_not_start_is_told_and_the_others_are_measured(tmp_path: Path) -> None:
    """An env that can't live in the trainer's process doesn't end the bench."""
    entry = {**STUB, "backend": "worker_only", "num_workers": 2}
    done = invoke("bench", write_config(tmp_path, entry), *QUICK)
    assert done.exit_code == 0
    assert "inline: env 'stub-0'" in done.stdout
    assert "needs a process of its own" in done.stdout


def test_a_bench_of_which_nothing_starts_fails(tmp_path: Path) -> None:
    """The cause is the message."""
    entry = {"name": "robot", "backend": "unbuildable", "task": "any"}
    done = invoke("bench", write_config(tmp_path, entry), *QUICK)
    assert done.exit_code == 1
    assert "no such robot" in done.stderr


def test_an_interrupted_bench_prints_what_it_has(tmp_path: Path) -> None:
    """Ctrl-C ends it with the measurements made so far."""
    import signal

    with start("bench", write_config(tmp_path, CARTPOLE), "--rounds", 10**6, "--json") as child:
        assert child.stderr is not None
        while not child.stderr.readline().startswith("measuring"):
            pass
        child.send_signal(signal.SIGINT)
        stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130
    assert "Traceback" not in stderr
    if stdout:
        assert json.loads(stdout)["contenders"]


def test_a_plot_without_matplotlib_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message says how to get it."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name)
    )
    done = invoke("bench", write_config(tmp_path, STUB), "--plot", tmp_path / "plot.png")
    assert done.exit_code == 2
    assert "pip install matplotlib" in done.stderr


def test_the_plot_is_an_image(tmp_path: Path) -> None:
    """--plot writes a PNG of what was measured."""
    if importlib.util.find_spec("matplotlib") is None:
        pytest.skip("matplotlib is not installed")
    path = tmp_path / "plot.png"
    # Matplotlib keeps its fonts open for the rest of the process, which is why it has its own.
    done = run("bench", write_config(tmp_path, CARTPOLE), *QUICK, "--plot", path)
    assert done.returncode == 0, done.stderr
    assert path.read_bytes().startswith(b"\x89PNG")


def test_what_tune_prints_of_inline_envs_loads(tmp_path: Path) -> None:
    """It leaves out what has no meaning there, defaults included."""
    entry = EnvConfig(name="a", backend="gymnasium", task="CartPole-v1", step_timeout=3.0)
    setting = measuring.Setting((moved(entry, "inline"),))
    best = SimpleNamespace(setting=setting, steps_per_second=1.0, rule=measuring.Rule("step", None))
    path = tmp_path / "tuned.yaml"
    path.write_text(tune._as_yaml(path, cast("Any", best)))
    (loaded,) = load_config(path)
    assert (loaded.placement, loaded.step_timeout) == ("inline", None)


def test_tune_prints_a_config_that_loads(tmp_path: Path) -> None:
    """Stdout is YAML that differs from the config in where the envs live, and nowhere else."""
    config = write_config(tmp_path, {**STUB, "max_episode_steps": 20})
    done = invoke("tune", config, *QUICK)
    assert done.exit_code == 0, done.stderr
    tuned = tmp_path / "tuned.yaml"
    tuned.write_text(done.stdout)
    (entry,), (asked_for,) = load_config(tuned), load_config(config)
    chosen = {"placement", "envs_per_process"}
    assert entry.model_dump(exclude=chosen) == asked_for.model_dump(exclude=chosen)
    assert entry.placement == "inline" or isinstance(entry.envs_per_process, int)
    assert "collect_async(min_results=" in done.stdout
    assert "Where the envs live" in done.stderr


def test_tune_chooses_among_the_finals(tmp_path: Path) -> None:
    """The best is one of the two fastest places, under one of the rules tried there."""
    document = invoke_json("tune", write_config(tmp_path, STUB), *QUICK)
    tried, best = document["tried"], document["best"]
    places, finals = tried[:4], tried[4:]
    assert settings_of(places) == [("process", 1), ("process", 2), ("process", 4), ("inline", 0)]
    assert [c["min_results"] for c in finals] == [1, 2, 3, 4] * 2
    assert best in finals
    fastest = max(c["steps_per_second"] for c in finals)
    assert best["steps_per_second"] >= 0.97 * fastest
    assert document["step_us"] > 0


@pytest.mark.parametrize("command", ["bench", "tune"])
def test_envs_that_live_elsewhere_are_no_choice(tmp_path: Path, command: str) -> None:
    """For a server of remote envs there is nothing to compare."""
    config = write_config(tmp_path, {"name": "robots", "backend": "env_server"})
    done = invoke(command, config)
    assert done.exit_code == 2
    assert "'robots'" in done.stderr


def entry(**fields: Any) -> EnvConfig:
    return EnvConfig(**{"name": "a", "backend": "gymnasium", "task": "CartPole-v1", **fields})


@pytest.mark.parametrize(
    ("fields", "workers"),
    [
        ({"num_workers": 1}, [1, 0]),
        ({"num_workers": 3}, [1, 2, 3, 0]),
        ({"num_workers": 64}, [1, 2, 4, 32, 0]),
        # Simulators with threads or devices of their own share no process.
        ({"num_workers": 3, "backend": "maniskill"}, [3, 0]),
        # What is set for workers alone can't be had in this process.
        ({"num_workers": 2, "env_vars": {"A": "1"}}, [1, 2]),
        ({"num_workers": 2, "interpreter": "/usr/bin/python3"}, [1, 2]),
    ],
)
def test_the_settings_that_are_tried(fields: dict[str, Any], workers: list[int]) -> None:
    """From one worker to one for each env, within reason, and this process where it may be."""
    settings = measuring.possible_settings([entry(**fields)])
    assert [setting.workers for setting in settings] == workers
    assert sum(setting.inline for setting in settings) == workers.count(0)
