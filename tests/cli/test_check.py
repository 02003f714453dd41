"""``check`` tries a config's envs; ``tasks`` lists tasks of a backend."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, write_config
from cli.stub_envs import Careless, Stub

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


def test_check_fails_if_an_env_fails(tmp_path: Path) -> None:
    """The message is that of every command."""
    entry = {"name": "cracked", "backend": "raising", "task": "any", "placement": "inline"}
    done = invoke("check", write_config(tmp_path, entry))
    assert (done.exit_code, done.stdout) == (1, "")
    assert "the floor is missing" in done.stderr


def test_tasks_lists_the_tasks_of_a_backend() -> None:
    """A backend without a list, and an unknown one, raise an error."""
    assert "CartPole-v1" in invoke("backends", "gymnasium").stdout.splitlines()
    assert "HalfCheetah-v5" in invoke_json("backends", "mujoco")
    assert "HalfCheetah-v5" not in invoke_json("backends", "gymnasium")
    for name, said in (("callable", "has no list"), ("mujuco", "did you mean 'mujoco'")):
        done = invoke("backends", name)
        assert done.exit_code == 2
        assert said in done.stderr


def test_check_plays_episodes_and_names_what_is_wrong(tmp_path: Path) -> None:
    """With so many steps; a sound env has no problem."""
    careless = {"name": "bad", "backend": "callable", "task": "cli.stub_envs:Careless"}
    config = write_config(tmp_path, INLINE, {**careless, "placement": "inline"})
    try:
        found = invoke_json("check", config, "--steps", "80")["entries"]
        text = invoke("check", config, "--steps", "80").stdout
    finally:
        while Careless.files:
            Careless.files.pop().close()
    good, bad = [each["trial"] for each in found]
    assert good["problems"] == []
    assert bad["episodes"] >= 10
    rewards, seed, *leaks = bad["problems"]
    assert "rewards are NaN" in rewards
    assert "differ from the reset on" in seed
    assert any("more open descriptors after" in leak for leak in leaks)
    assert "problem: none found" in text


@pytest.mark.parametrize(
    ("env", "placement"),
    [("Casting", "inline"), ("Casting", "process"), ("AwaitedCasting", "loop")],
)
def test_check_names_observations_that_are_cast(env: str, placement: str, tmp_path: Path) -> None:
    """It says which part, from what to what, and whether numbers were rounded."""
    entry = {"name": "c", "backend": "callable", "task": f"cli.stub_envs:{env}"}
    config = write_config(tmp_path, {**entry, "placement": placement})
    (found,) = invoke_json("check", config, "--steps", "20")["entries"]
    casts = {cast.pop("part"): cast for cast in found["trial"]["casts"]}
    narrow = {"found": "float64", "expected": "float32", "rounds": True}
    assert casts == {
        "observation['pose']": narrow,
        "observation['count']": {"found": "int64", "expected": "int32", "rounds": False},
        "observation['list']": {"found": "list", "expected": "float32", "rounds": False},
    }
    assert found["trial"]["problems"] == []


def test_check_says_casts_in_words(tmp_path: Path) -> None:
    """An env whose dtypes are right has no such line."""
    entry = {"name": "c", "backend": "callable", "task": "cli.stub_envs:Narrow"}
    narrow = {**entry, "placement": "inline", "max_episode_steps": 5}
    lines = invoke("check", write_config(tmp_path, INLINE, narrow), "--steps", "9").stdout
    (line,) = [line for line in lines.splitlines() if "cast" in line]
    assert line == (
        "  cast: observation from float64 to float32: no number changes, but it takes time; "
        "return arrays of float32, or declare a space of another dtype"
    )
