"""``bench`` and ``tune``: what they compare, and that what they print can be used."""

from __future__ import annotations

import csv
import importlib.util
import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest
from cli import stub_policies
from cli.command import CARTPOLE, invoke, invoke_json, run, start, write_config
from patience import HANG
from timelines import Seen

from rlightning_aio import EnvConfig, load_config
from rlightning_aio.cli import bench, measuring, settings, tune
from rlightning_aio.config import moved

if TYPE_CHECKING:
    from pathlib import Path

STUB = {"name": "stub", "backend": "stub", "task": "any", "num_workers": 4}
QUICK = ["--seconds", 0.01, "--rounds", 2]


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings tried depend on the machine."""
    monkeypatch.setattr(settings, "num_cores", lambda: 2)


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
    assert all(c["start_seconds"] > 0 and c["reset_seconds"] > 0 for c in contenders)
    assert all(c["cores"] >= 0 and c["memory_bytes"] >= 0 for c in contenders)
    assert document["versions"]["gymnasium"]
    assert (document["interrupted"], document["cores"] > 0) == (False, True)


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
        document = json.loads(stdout)
        assert (document["interrupted"], bool(document["contenders"])) == (True, True)


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


def test_the_plot_of_a_rollout_is_an_image(tmp_path: Path) -> None:
    """Rates and returns of each entry."""
    if importlib.util.find_spec("matplotlib") is None:
        pytest.skip("matplotlib is not installed")
    path = tmp_path / "plot.svg"
    config = write_config(tmp_path, CARTPOLE, {**CARTPOLE, "name": "other"})
    done = run("rollout", config, "--steps", 500, "--plot", path)
    assert done.returncode == 0, done.stderr
    assert b"<svg" in path.read_bytes()


def test_what_tune_prints_of_inline_envs_loads(tmp_path: Path) -> None:
    """It leaves out what has no meaning there, defaults included."""
    entry = EnvConfig(name="a", backend="gymnasium", task="CartPole-v1", step_timeout=3.0)
    setting = settings.Setting((moved(entry, "inline"),), "inline")
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
    chosen = {"placement", "envs_per_process", "min_results"}
    assert entry.model_dump(exclude=chosen) == asked_for.model_dump(exclude=chosen)
    assert entry.placement == "inline" or isinstance(entry.envs_per_process, int)
    assert entry.min_results is not None
    assert f"collect_async(min_results={entry.min_results})" in done.stdout
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


def found(*entries: EnvConfig) -> list[tuple[str, int, list[tuple[int, int]]]]:
    """The settings tried: where, in how many workers, and how many envs of how many each."""
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
        # Simulators with threads or devices of their own share no process.
        ({"num_workers": 3, "backend": "maniskill"}, [3, 0]),
        # What is set for workers alone can't be had in this process.
        ({"num_workers": 2, "env_vars": {"A": "1"}}, [1, 2]),
        ({"num_workers": 2, "interpreter": "/usr/bin/python3"}, [1, 2]),
    ],
)
def test_the_numbers_of_workers_that_are_tried(fields: dict[str, Any], workers: list[int]) -> None:
    """From one worker to one for each env, within reason, and this process where it may be."""
    sizes = [(fields["num_workers"], 1)]
    tried = [(where, count) for where, count, own in found(entry(**fields)) if own == sizes]
    assert [count for where, count in tried if where != "split"] == workers
    assert [where for where, count in tried if count == 0] == ["inline"] * workers.count(0)


def test_simulations_that_can_share_an_env_are_tried_that_way() -> None:
    """CartPole-v1 has a vector entry point: whether that, and where, is best is found out, too."""
    tried = found(entry(num_workers=8))
    eight, four, one = [(8, 1)], [(2, 4)], [(1, 8)]
    assert {"inline", "split"} == {where for where, _, own in tried if own == eight} - {"process"}
    assert ("inline", 0, one) in tried
    assert ("process", 1, one) in tried
    assert ("process", 2, four) in tried
    assert ("split", 1, four) in tried
    # However they are configured, and beside entries that can't be had like that.
    assert found(entry(num_envs=8))[:1] == [("process", 1, one)]
    assert ("process", 2, four) in found(entry(num_envs=8))
    other = entry(name="b", backend="callable", task="module:make", num_workers=3)
    assert ("inline", 0, [(1, 8), (3, 1)]) in found(entry(num_workers=8), other)


def test_what_tune_prints_is_complete(tmp_path: Path) -> None:
    """Sub-environments, and the results to wait for, dealt out over the entries."""
    entries = tuple(
        EnvConfig(name=name, backend="gymnasium", task="CartPole-v1", num_workers=n, num_envs=2)
        for name, n in (("a", 1), ("b", 2), ("c", 4))
    )
    setting = settings._in_workers(entries, 2)
    rule = measuring.Rule("any", 5)
    best = measuring.Contender(setting, rule, [measuring.Round(100.0, (1.0, 2.0), 1.0)])
    path = tmp_path / "tuned.yaml"
    path.write_text(tune._as_yaml(path, best))
    loaded = load_config(path)
    assert [(c.num_workers, c.num_envs) for c in loaded] == [(1, 2), (2, 2), (4, 2)]
    assert sum(c.min_results or 0 for c in loaded) == 5


def test_baselines_stand_in_the_same_table(tmp_path: Path) -> None:
    """A plain loop and Gymnasium's two vector envs step what it can make; CSV has all figures."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2, "max_episode_steps": 5})
    # What Gymnasium shares with its processes is kept for the rest of this one.
    done = run("bench", config, "--seconds", 0.005, "--rounds", 1, "--format", "csv")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(done.stdout.splitlines()))
    assert [row["place"] for row in rows[-3:]] == ["bare loop", "SyncVectorEnv", "AsyncVectorEnv"]
    assert all(float(row["steps_per_second"]) > 0 for row in rows)


def test_a_policy_and_a_seed_are_used(tmp_path: Path) -> None:
    """Every place steps with the policy's actions; what takes no batch is left out."""
    config = write_config(tmp_path, {**STUB, "num_workers": 1})
    stub_policies.furthest_seen.clear()
    words = ("--policy", "cli.stub_policies:furthest", "--seed", 3, "--rounds", 1)
    done = invoke("bench", config, *words, "--seconds", 0.005, "--format", "markdown")
    assert done.exit_code == 0, done.stderr
    head, line, *rows = done.stdout.splitlines()
    assert head.startswith("| envs in | results | steps/s |")
    assert set(line) <= set("|-: ")
    assert not [row for row in rows if "VectorEnv" in row]
    assert stub_policies.furthest_seen


def test_what_was_saved_is_compared_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 3 where all rounds are slower than all that were saved, and only there."""
    monkeypatch.chdir(tmp_path)
    config = write_config(tmp_path, {**STUB, "num_workers": 1})
    words = ("bench", config, "--seconds", 0.005, "--rounds", 1)
    missing = invoke(*words, "--compare", "before")
    assert (missing.exit_code, missing.stdout) == (2, "")
    assert invoke(*words, "--save", "before").exit_code == 0
    saved = tmp_path / ".rlightning-aio" / "bench" / "before.json"
    document = json.loads(saved.read_text())
    for factor, code in ((1e-6, 0), (1e6, 3)):
        changed = json.loads(json.dumps(document))
        for contender in changed["contenders"]:
            contender["rounds"] = [rate * factor for rate in contender["rounds"]]
        saved.write_text(json.dumps(changed | {"cpu": "another"}))
        done = invoke(*words, "--compare", "before", "--json")
        assert done.exit_code == code, done.stderr
        comparison = json.loads(done.stdout)["comparison"]
        assert comparison["slower"] == (len(document["contenders"]) if code else 0)
        assert comparison["differences"][0].startswith("cpu was another")


def test_a_plot_that_can_not_be_written_is_found_before_anything_is_measured(
    tmp_path: Path,
) -> None:
    """A folder that isn't there, a folder in its place, and a kind that is none."""
    config = write_config(tmp_path, STUB)
    (tmp_path / "taken.png").mkdir()
    for name, why in (
        ("no/plot.png", "No such file"),
        ("taken.png", "Is a directory"),
        ("plot.txt", "should end in"),
    ):
        done = invoke("bench", config, "--plot", tmp_path / name)
        assert done.exit_code == 2
        assert why in done.stderr
        assert "starting" not in done.stderr
    assert not (tmp_path / "plot.png").exists()


def test_bench_traces_the_fastest(tmp_path: Path) -> None:
    """One file, of one measurement more; the figures are as many as without."""
    config = write_config(tmp_path, {**STUB, "num_workers": 1})
    document = invoke_json("bench", config, *QUICK, "--trace", tmp_path / "run.json")
    assert all(len(c["rounds"]) == 2 for c in document["contenders"])
    assert Seen(tmp_path / "run.json").called("step")
