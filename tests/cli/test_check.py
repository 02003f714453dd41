"""``check`` and ``tasks``: what a config's envs are like, and what else there is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cli.command import CARTPOLE, invoke, invoke_json, write_config
from cli.stub_envs import Stub

if TYPE_CHECKING:
    from pathlib import Path

INLINE = {**CARTPOLE, "placement": "inline"}


def test_spaces_are_printed_of_envs_that_work(tmp_path: Path) -> None:
    """One env of each entry is built and stepped, however many there are."""
    stub = {"name": "stub", "backend": "stub", "task": "any", "placement": "inline"}
    config = write_config(tmp_path, {**INLINE, "num_envs": 3}, {**stub, "num_workers": 50})
    Stub.steps = 0
    first, second = invoke_json("check", config)["entries"]
    assert Stub.steps == 3
    assert (first["num_envs"], first["max_episode_steps"]) == (3, 500)
    assert first["action_space"].startswith("MultiDiscrete([2 2 2]")
    assert (second["num_workers"], second["action_space"]) == (50, "Discrete(2)")
    assert "  action       Discrete(2)" in invoke("check", config).stdout.splitlines()


def test_what_can_not_be_started_is_left_alone_and_named(tmp_path: Path) -> None:
    """A robot would move; a server's envs live elsewhere."""
    config = write_config(tmp_path, INLINE, {"name": "robots", "backend": "env_server"})
    lines = invoke("check", config).stdout.splitlines()
    assert lines[-2:] == [
        "robots: 1 env (env_server)",
        "  not started: its envs live with its clients",
    ]


def test_an_env_that_fails_fails_the_check(tmp_path: Path) -> None:
    """With the message that any command has."""
    entry = {"name": "cracked", "backend": "raising", "task": "any", "placement": "inline"}
    done = invoke("check", write_config(tmp_path, entry))
    assert (done.exit_code, done.stdout) == (1, "")
    assert "the floor is missing" in done.stderr


def test_tasks_of_a_backend_are_listed() -> None:
    """Each backend has its own; one that has no list says so, and one that is none."""
    assert "CartPole-v1" in invoke("tasks", "gymnasium").stdout.splitlines()
    assert "HalfCheetah-v5" in invoke_json("tasks", "mujoco")
    assert "HalfCheetah-v5" not in invoke_json("tasks", "gymnasium")
    for name, said in (("callable", "has no list"), ("mujuco", "did you mean 'mujoco'")):
        done = invoke("tasks", name)
        assert done.exit_code == 2
        assert said in done.stderr
