"""``check`` tries a config's envs."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, write_config
from cli.stub_envs import Careless, Leaky, Stub
from group.sample_envs import Crowd

if TYPE_CHECKING:
    from pathlib import Path

INLINE = {**CARTPOLE, "placement": "inline"}


def test_check_prints_the_spaces_of_working_envs(tmp_path: Path) -> None:
    """It builds and steps one env of each entry."""
    stub = {"name": "stub", "backend": "stub", "task": "any", "placement": "inline"}
    config = write_config(tmp_path, {**INLINE, "num_envs": 3}, {**stub, "num_workers": 50})
    Stub.steps = 0
    first, second = invoke_json("check", config)["entries"]
    assert Stub.steps == 3
    assert (first["num_envs"], first["max_episode_steps"]) == (3, 500)
    assert first["action_space"].startswith("MultiDiscrete([2 2 2]")
    assert (second["num_workers"], second["action_space"]) == (50, "Discrete(2)")
    assert "  action       Discrete(2)" in invoke("check", config).stdout.splitlines()


def test_check_names_the_envs_that_it_does_not_start(tmp_path: Path) -> None:
    """These are robots, which would move, and env_servers, whose envs live elsewhere."""
    config = write_config(tmp_path, INLINE, {"name": "robots", "backend": "env_server"})
    lines = invoke("check", config).stdout.splitlines()
    assert lines[-2:] == [
        "robots: 1 env (env_server)",
        "  not started: its envs live with its clients",
    ]


def failed(*words: object) -> Any:
    """Run the command, which finds something; return its document."""
    done = invoke("check", *words, "--json")
    assert done.exit_code == 1, done.stderr
    return json.loads(done.stdout)["entries"]


def test_check_plays_episodes_and_names_what_is_wrong(tmp_path: Path) -> None:
    """With so many steps; a sound env has no problem."""
    careless = {"name": "bad", "backend": "callable", "task": "cli.stub_envs:Careless"}
    config = write_config(tmp_path, INLINE, {**careless, "placement": "inline"})
    try:
        good, bad = failed(config, "--steps", "80")
        text = invoke("check", config, "--steps", "80").stdout
    finally:
        while Careless.files:
            Careless.files.pop().close()
    assert good["problems"] == []
    assert bad["episodes"] >= 10
    rewards, *leaks, seed = bad["problems"]
    assert "rewards are NaN" in rewards
    assert "differ from the reset on" in seed
    assert any("more open descriptors after" in leak for leak in leaks)
    assert "problem: none found" in text
    assert "placement" not in text


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_what_leaks_memory_gets_a_limit(tmp_path: Path, placement: str) -> None:
    """Where there is a worker that can be renewed, and its generators go over."""
    entry = {"name": "leaky", "backend": "callable", "task": "cli.stub_envs:Leaky"}
    entry |= {"placement": placement, "imports": ["cli.stub_envs"]}
    try:
        (found,) = failed(write_config(tmp_path, entry), "--steps", "60")
    finally:
        Leaky.kept.clear()
    (problem,) = found["problems"]
    assert re.match(r"\d+ more MB of memory after \d+ episodes", problem)
    limit = re.search(r"recycle: {memory_mb: (\d+)00}", problem)
    assert (limit is not None) == (placement == "process")


@pytest.mark.parametrize("num_envs", [1, 3])
def test_it_says_of_how_many_rewards_some_are_nan(tmp_path: Path, num_envs: int) -> None:
    """Resets have none, and each sub-environment has its own."""
    entry = {"name": "nan", "backend": "nan", "task": "any", "num_envs": num_envs}
    entry |= {"placement": "inline", "env_kwargs": {"episode_length": 1}}
    (found,) = failed(write_config(tmp_path, entry), "--steps", "9")
    assert found["problems"][0].startswith(f"{5 * num_envs} of {5 * num_envs} rewards are NaN")
    assert found["step_us"] is not None


def test_problems_are_printed_where_no_step_was_timed(tmp_path: Path) -> None:
    """Each result of one of the sub-environments is a reset."""
    entry = {"name": "nan", "backend": "nan", "task": "any", "placement": "inline"}
    done = invoke("check", write_config(tmp_path, {**entry, "num_envs": 2}), "--steps", "1")
    assert done.exit_code == 1
    assert "  problem: 2 of 2 rewards are NaN or infinite" in done.stdout


def test_envs_of_several_agents_are_played(tmp_path: Path) -> None:
    """An episode is over when it is for all of them."""
    assert Crowd.agents == ("tall", "small")
    entry = {"name": "two", "backend": "crowd", "task": "any", "placement": "inline"}
    (found,) = invoke_json("check", write_config(tmp_path, entry), "--steps", "12")["entries"]
    assert (found["episodes"], found["problems"]) == (3, [])


def test_a_sound_env_is_code_0(tmp_path: Path) -> None:
    """The document has the time of a step."""
    (found,) = invoke_json("check", write_config(tmp_path, INLINE), "--steps", "80")["entries"]
    assert found["step_us"] > 0
    assert invoke_json("check", write_config(tmp_path, INLINE))["entries"][0]["step_us"] is None


def test_no_env_is_stepped_whose_actions_only_a_policy_can_choose(tmp_path: Path) -> None:
    talk = {"name": "t", "task": "cli.stub_envs:Talk", "placement": "loop"}
    config = write_config(tmp_path, talk)
    lines = invoke("check", config).stdout.splitlines()
    assert lines[-1] == "  reset; not stepped: only a policy can choose its actions"
    (entry,) = invoke_json("check", config)["entries"]
    assert (entry["action_space"], entry["steps"]) == ("Anything()", 0)


@pytest.mark.parametrize(
    ("env", "placement"),
    [("Casting", "inline"), ("Casting", "process"), ("AwaitedCasting", "loop")],
)
def test_check_names_observations_that_are_cast(env: str, placement: str, tmp_path: Path) -> None:
    """It says which part, from what to what, and whether numbers were rounded."""
    entry = {"name": "c", "backend": "callable", "task": f"cli.stub_envs:{env}"}
    (found,) = failed(write_config(tmp_path, {**entry, "placement": placement}), "--steps", "20")
    said = [problem.partition(";")[0] for problem in found["problems"]]
    free = "no number changes, but it takes time"
    assert said == [
        f"observation['both'][1] is converted from float64 to float32: {free}",
        f"observation['count'] is converted from int64 to int32: {free}",
        f"observation['list'] is converted from list to float32: {free}",
        "observation['pose'] is converted from float64 to float32: numbers are rounded",
    ]


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_check_names_numbers_outside_of_the_space(tmp_path: Path, placement: str) -> None:
    """As the env returns them."""
    entry = {"name": "c", "backend": "callable", "task": "cli.stub_envs:Beyond"}
    (found,) = failed(write_config(tmp_path, {**entry, "placement": placement}), "--steps", "20")
    (problem,) = found["problems"]
    assert problem == (
        "an observation holds 2.0, and the space goes from 0.0 to 1.0: clip it, or declare a "
        "wider space"
    )


@pytest.mark.parametrize("where", ["info", "observation"])
def test_actions_obey_masks(tmp_path: Path, where: str) -> None:
    """Also where observations are compared with their space."""
    masked = {"name": "m", "task": "cli.stub_envs:Masked", "env_kwargs": {"where": where}}
    config = write_config(tmp_path, {**masked, "placement": "inline"})
    (found,) = invoke_json("check", config, "--steps", "30")["entries"]
    assert found["problems"] == []
