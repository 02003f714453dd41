"""Errors end a command with an exit code and one message, without a traceback."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, invoke, run, write_config

if TYPE_CHECKING:
    from pathlib import Path

STUB = {"name": "stub", "backend": "stub", "task": "any"}


def test_a_wrong_config_shows_no_traceback(tmp_path: Path) -> None:
    """Stderr has one line."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": -1})
    done = run("rollout", config)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "num_workers" in done.stderr


@pytest.mark.parametrize("words", [["--steps", "0"], ["--min-results", "none"], ["--nonsense"]])
def test_a_wrong_option_is_code_2(tmp_path: Path, words: list[str]) -> None:
    """It is refused before anything starts."""
    done = invoke("rollout", write_config(tmp_path, CARTPOLE), *words)
    assert done.exit_code == 2
    assert words[0] in done.stderr


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("nonsense", "should look like my_policies:greedy"),
        ("no_such_module:f", "No module named 'no_such_module'"),
        ("cli.stub_policies:nothing", "has no 'nothing'"),
        ("cli.stub_policies:not_callable", "is a int, neither a callable nor with a predict()"),
    ],
)
def test_an_invalid_policy_is_code_2(tmp_path: Path, policy: str, message: str) -> None:
    """It is named before any env starts."""
    done = invoke("rollout", write_config(tmp_path, CARTPOLE), "--policy", policy)
    assert done.exit_code == 2
    assert f"--policy '{policy}': " in done.stderr
    assert message in done.stderr
    assert "starting" not in done.stderr


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_an_env_that_raises_is_code_1(tmp_path: Path, placement: str) -> None:
    """The message names the env and the line; the table has the results so far."""
    raising = {"name": "cracked", "backend": "raising", "task": "any", "placement": placement}
    done = invoke("rollout", write_config(tmp_path, raising))
    assert done.exit_code == 1
    assert done.stdout.startswith("2 steps in ")
    message = done.stderr.splitlines()[-1]
    assert "env 'cracked-0'" in message
    assert "ZeroDivisionError: the floor is missing" in message
    assert "stub_envs.py" in message
    assert "Traceback" not in done.stderr


def test_a_dead_worker_is_code_1(tmp_path: Path) -> None:
    """The config asks for it with on_worker_death: raise."""
    dying = {"name": "frail", "backend": "dying", "task": "any", "on_worker_death": "raise"}
    done = invoke("rollout", write_config(tmp_path, dying), "--json")
    assert done.exit_code == 1
    assert json.loads(done.stdout)["steps"] == 2
    assert "'frail-0'" in done.stderr
    assert "exited with code 7" in done.stderr


@pytest.mark.filterwarnings("ignore:close.. of env 'frail-0' raised WorkerDied")
def test_a_rollout_continues_after_a_worker_is_replaced(tmp_path: Path) -> None:
    """A dead worker is replaced by default. The table and the document say so."""
    dying = {"name": "frail", "backend": "dying", "task": "any", "max_restarts": 10**6}
    config = write_config(tmp_path, dying)
    done = invoke("rollout", config, "--steps", 4)
    assert done.exit_code == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["restarts", "1"] in lines
    assert ["outcomes_env_died", "1"] in lines
    numbers = json.loads(invoke("rollout", config, "--steps", 4, "--json").stdout)["metrics"]
    assert numbers["envs/restarts"] == numbers["envs/frail/restarts"] == 1


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_an_env_that_cannot_be_built_is_code_1(tmp_path: Path, placement: str) -> None:
    """There is no table; the message has the cause."""
    entry = {"name": "robot", "backend": "unbuildable", "task": "any", "placement": placement}
    done = invoke("rollout", write_config(tmp_path, entry))
    assert done.exit_code == 1
    assert done.stdout == ""
    assert "'robot-0'" in done.stderr
    assert "FileNotFoundError: no such robot" in done.stderr
    assert "above" not in done.stderr


def test_a_missing_simulator_is_code_2_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message comes before any worker starts."""
    from rlightning_aio.registry import Backend

    monkeypatch.setattr(Backend, "is_installed", lambda self: False)
    done = invoke("rollout", write_config(tmp_path, CARTPOLE))
    assert done.exit_code == 2
    assert "pip install" in done.stderr


def test_actions_that_do_not_fit_are_code_1(tmp_path: Path) -> None:
    """A policy may return too few, for example."""
    config = write_config(tmp_path, {**STUB, "placement": "inline", "num_workers": 3})
    done = invoke("rollout", config, "--policy", "cli.stub_policies:too_few")
    assert done.exit_code == 1
    assert "2 rows for a batch of 3" in done.stderr


def test_an_exception_of_a_policy_shows_its_own_code(tmp_path: Path) -> None:
    """The traceback leaves out this library's code."""
    config = write_config(tmp_path, {**STUB, "placement": "inline"})
    done = invoke("rollout", config, "--policy", "cli.stub_policies:broken")
    assert (done.exit_code, done.stdout) == (1, "")
    message = done.stderr.partition("error: ")[2]
    assert message.startswith("the policy raised LookupError: no such weights\n")
    places = [line for line in message.splitlines() if line.startswith("  File ")]
    assert ["stub_policies.py" in place for place in places] == [True]


@pytest.mark.parametrize("command", ["rollout", "eval"])
def test_missing_clients_are_one_message(tmp_path: Path, command: str) -> None:
    """It has the server, its address and the time waited."""
    server = {"name": "robots", "backend": "env_server", "env_kwargs": {"connect_timeout": 0.01}}
    done = invoke(command, write_config(tmp_path, server))
    assert (done.exit_code, done.stdout) == (1, "")
    assert "no client has dialled in for robots-0/0 within 0.01 s" in done.stderr


def test_a_warning_is_one_line(tmp_path: Path) -> None:
    """It leaves out the line of code that raised it."""
    entry = {"name": "box", "backend": "unclosable", "task": "any"}
    done = run("rollout", write_config(tmp_path, entry), "--steps", 5)
    assert done.returncode == 0
    (warning,) = [line for line in done.stderr.splitlines() if "the lid is stuck" in line]
    assert warning.startswith("warning: close() of env 'box-0' raised")
    assert "self." not in done.stderr


@pytest.mark.parametrize("command", ["rollout", "eval", "bench"])
def test_a_seed_that_is_too_large_is_code_2(tmp_path: Path, command: str) -> None:
    done = invoke(command, write_config(tmp_path, STUB), "--seed", 2**61 + 1)
    assert done.exit_code == 2
    assert str(2**61) in done.stderr


def test_the_largest_seed_is_taken(tmp_path: Path) -> None:
    for command, length in (("rollout", "--steps"), ("eval", "--episodes")):
        done = invoke(command, write_config(tmp_path, STUB), "--seed", 2**61, length, 2)
        assert done.exit_code == 0, done.stderr
