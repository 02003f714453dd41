"""``rlightning-aio rollout`` collects steps and prints statistics."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, run, write_config

if TYPE_CHECKING:
    from pathlib import Path


def test_rollout_prints_the_numbers_of_each_entry(tmp_path: Path) -> None:
    """It collects exactly the given number of steps, from workers."""
    config = write_config(
        tmp_path,
        {**CARTPOLE, "num_workers": 3},
        {**CARTPOLE, "name": "short", "num_workers": 2, "max_episode_steps": 7},
    )
    done = run("rollout", config, "--steps", 1234)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("1,234 steps in ")
    assert done.stdout.splitlines()[1].split() == ["all", "pole", "short"]
    lines = [line.split() for line in done.stdout.splitlines()[2:]]
    numbers = {line[0]: line[1:] for line in lines}
    whole, pole, short = (int(text.replace(",", "")) for text in numbers["steps"])
    assert pole + short == whole == 1234
    assert numbers["envs"] == ["5", "3", "2"]
    assert float(numbers["mean_length"][2]) <= 7
    assert "outcomes_env_died" not in numbers
    assert "Traceback" not in done.stderr


def test_stdout_is_one_json_document(tmp_path: Path) -> None:
    """Other messages go to stderr."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2})
    done = run("rollout", config, "--steps", 500, "--json")
    document = json.loads(done.stdout)
    numbers = document["metrics"]
    assert (document["steps"], document["interrupted"]) == (500, False)
    assert (numbers["envs/steps"], numbers["envs/pole/steps"], numbers["envs/envs"]) == (
        500,
        500,
        2,
    )
    assert numbers["envs/episode_returns"] == numbers["envs/episode_lengths"] > 1
    assert document["steps_per_second"] == pytest.approx(500 / document["seconds"])
    assert "collecting 500 steps" in done.stderr


def test_a_seed_repeats_a_rollout(tmp_path: Path) -> None:
    """This holds in one process; another seed gives other episodes."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 3, "placement": "inline"})

    def episodes(seed: int) -> tuple[int, float]:
        numbers = invoke_json("rollout", config, "--steps", 600, "--seed", seed)["metrics"]
        return numbers["envs/outcomes_terminated"], numbers["envs/episode_returns"]

    assert episodes(3) == episodes(3)
    assert episodes(3) != episodes(4)


def mean_length(numbers: dict[str, float]) -> float:
    return numbers["envs/episode_lengths"] / numbers["envs/episodes"]


def test_a_policy_chooses_the_actions(tmp_path: Path) -> None:
    """A pole that is always pushed to one side falls within eleven steps."""
    (tmp_path / "one_sided.py").write_text("def left(batch):\n    return [0] * len(batch)\n")
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2, "imports": []})
    done = run(
        *("rollout", config, "imports=[]", "--steps", 200, "--policy", "one_sided:left", "--json"),
        cwd=tmp_path,
    )
    assert 8 <= mean_length(json.loads(done.stdout)["metrics"]) <= 11


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_printing_of_other_code_goes_to_stderr(tmp_path: Path, placement: str) -> None:
    """This includes envs, processes they start, and policies, until the end."""
    talkative = {"name": "a", "backend": "talkative", "task": "any", "placement": placement}
    words = ("--steps", 20, "--policy", "cli.stub_policies:respond", "--json")
    done = run("rollout", write_config(tmp_path, talkative), *words)
    assert json.loads(done.stdout)["steps"] == 20
    printed = {"made", "stepped", "stepped in C", "stepped elsewhere", "closed"}
    printed |= {"policies that print when they are imported"}
    assert printed <= set(done.stderr.splitlines())


@pytest.mark.parametrize("name", ["model", "by_entry"])
def test_a_policy_may_be_what_evaluate_takes(tmp_path: Path, name: str) -> None:
    """A model with `predict`, or a dict with one policy for each entry."""
    words = ("--policy", f"cli.stub_policies:{name}", "--json")
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2, "placement": "inline"})
    numbers = json.loads(invoke("rollout", config, "--steps", 100, *words).stdout)["metrics"]
    assert 8 <= mean_length(numbers) <= 11
    found = json.loads(invoke("eval", config, "--episodes", 2, *words).stdout)
    assert 8 <= found["length"]["mean"] <= 11


def test_an_entry_without_a_policy_is_named(tmp_path: Path) -> None:
    config = write_config(tmp_path, {**CARTPOLE, "name": "other", "placement": "inline"})
    done = invoke("rollout", config, "--policy", "cli.stub_policies:by_entry")
    assert done.exit_code == 2
    assert "no policy was given for the envs of entry 'other'" in done.stderr
