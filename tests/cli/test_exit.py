"""How commands end when something is wrong: the exit code, one message, no traceback."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, invoke, run, write_config

if TYPE_CHECKING:
    from pathlib import Path

STUB = {"name": "stub", "backend": "stub", "task": "any"}

# A YAML text, overrides, and what the message has to name beside the file.
WRONG: dict[str, tuple[str, list[str], list[str]]] = {
    "no list": ("envs: 3", [], ["envs", "should be a list"]),
    "an empty list": ("envs: []", [], ["envs", "no entries"]),
    "no YAML": ("envs: [", [], ["line ", "not valid YAML"]),
    "an unknown field": (
        "envs: [{name: a, backend: gymnasium, task: CartPole-v1, num_worker: 2}]",
        [],
        ["envs.0 ('a')", "num_worker", "num_workers"],
    ),
    "a wrong type": (
        "envs: [{name: a, backend: gymnasium, task: CartPole-v1, num_workers: many}]",
        [],
        ["envs.0 ('a')", "num_workers", "'many'"],
    ),
    "an unknown backend": (
        "envs: [{name: a, backend: mujuco, task: HalfCheetah-v5}]",
        [],
        ["envs.0 ('a')", "backend", "'mujoco'"],
    ),
    "vectorised where there is no such thing": (
        "envs: [{name: a, backend: piper, task: can0, num_envs: 4}]",
        [],
        ["envs.0 ('a')", "num_envs", "num_workers: 4"],
    ),
    "a missing module": (
        "{imports: [no_such_module], envs: [{name: a, backend: gymnasium, task: CartPole-v1}]}",
        [],
        ["imports", "no_such_module"],
    ),
    "an override of nothing": (
        "envs: [{name: a, backend: gymnasium, task: CartPole-v1}]",
        ["envs.3.num_workers=2"],
        ["override 'envs.3.num_workers=2'"],
    ),
    "an override that is none": (
        "envs: [{name: a, backend: gymnasium, task: CartPole-v1}]",
        ["num_workers"],
        ["override 'num_workers'", "envs.0.num_workers=8"],
    ),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("command", ["rollout", "bench", "tune"])
def test_a_wrong_config_is_code_2_and_names_its_place(
    tmp_path: Path, command: str, wrong: tuple[str, list[str], list[str]]
) -> None:
    """File, entry and field are in the one message; nothing is on stdout."""
    text, overrides, named = wrong
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    done = invoke(command, path, *overrides)
    assert done.exit_code == 2
    assert done.stdout == ""
    assert done.stderr.startswith(f"error: {path}: ")
    assert [words for words in named if words not in done.stderr] == []


def test_a_wrong_config_shows_no_traceback(tmp_path: Path) -> None:
    """The process itself says one line."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": -1})
    done = run("rollout", config)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "num_workers" in done.stderr


def test_a_missing_file_is_named() -> None:
    """A path that leads nowhere is a wrong configuration."""
    done = invoke("rollout", "nowhere.yaml")
    assert done.exit_code == 2
    assert done.stderr.startswith("error: nowhere.yaml: ")


@pytest.mark.parametrize("words", [["--steps", "0"], ["--min-results", "none"], ["--nonsense"]])
def test_a_wrong_option_is_code_2(tmp_path: Path, words: list[str]) -> None:
    """The command line itself is checked before anything starts."""
    done = invoke("rollout", write_config(tmp_path, CARTPOLE), *words)
    assert done.exit_code == 2
    assert words[0] in done.stderr


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("nonsense", "should look like my_policies:greedy"),
        ("no_such_module:f", "No module named 'no_such_module'"),
        ("cli.stub_policies:nothing", "has no 'nothing'"),
        ("cli.stub_policies:not_callable", "is a int, not a callable"),
    ],
)
def test_a_policy_that_is_none_is_code_2(tmp_path: Path, policy: str, message: str) -> None:
    """It is found before any env starts, and named."""
    done = invoke("rollout", write_config(tmp_path, CARTPOLE), "--policy", policy)
    assert done.exit_code == 2
    assert f"--policy '{policy}': " in done.stderr
    assert message in done.stderr
    assert "starting" not in done.stderr


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_an_env_that_raises_is_code_1_with_what_came_before(tmp_path: Path, placement: str) -> None:
    """The message names the env and the line that raised; the table shows what there is."""
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
    """Where the config says so, a worker's end is the command's."""
    dying = {"name": "frail", "backend": "dying", "task": "any", "on_worker_death": "raise"}
    done = invoke("rollout", write_config(tmp_path, dying), "--json")
    assert done.exit_code == 1
    assert json.loads(done.stdout)["steps"] == 2
    assert "'frail-0'" in done.stderr
    assert "exited with code 7" in done.stderr


@pytest.mark.filterwarnings("ignore:close.. of env 'frail-0' raised WorkerDied")
def test_a_worker_that_is_replaced_ends_nothing(tmp_path: Path) -> None:
    """By default a dead worker is replaced, and the rollout goes on."""
    dying = {"name": "frail", "backend": "dying", "task": "any", "max_restarts": 10**6}
    done = invoke("rollout", write_config(tmp_path, dying), "--steps", 20)
    assert done.exit_code == 0, done.stderr


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_an_env_that_can_not_be_built_is_code_1(tmp_path: Path, placement: str) -> None:
    """No table: nothing came. The cause is named."""
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
    """It is found before any worker starts."""
    from rlightning_aio.registry import Backend

    monkeypatch.setattr(Backend, "installed_version", lambda self: None)
    done = invoke("rollout", write_config(tmp_path, CARTPOLE))
    assert done.exit_code == 2
    assert "pip install" in done.stderr


def test_actions_that_do_not_fit_are_code_1(tmp_path: Path) -> None:
    """A policy that answers too few is told so."""
    config = write_config(tmp_path, {**STUB, "placement": "inline", "num_workers": 3})
    done = invoke("rollout", config, "--policy", "cli.stub_policies:too_few")
    assert done.exit_code == 1
    assert "2 rows for a batch of 3" in done.stderr


def test_a_policy_that_raises_shows_the_way_through_its_own_code(tmp_path: Path) -> None:
    """It is the user's code: where it went wrong is what they need, and nothing else."""
    config = write_config(tmp_path, {**STUB, "placement": "inline"})
    done = invoke("rollout", config, "--policy", "cli.stub_policies:broken")
    assert (done.exit_code, done.stdout) == (1, "")
    message = done.stderr.partition("error: ")[2]
    assert message.startswith("the policy raised LookupError: no such weights\n")
    places = [line for line in message.splitlines() if line.startswith("  File ")]
    assert ["stub_policies.py" in place for place in places] == [True]


def test_clients_that_do_not_come_are_one_message(tmp_path: Path) -> None:
    """It names the server, its address and for how long it has waited."""
    server = {"name": "robots", "backend": "env_server", "env_kwargs": {"connect_timeout": 0.01}}
    done = invoke("rollout", write_config(tmp_path, server))
    assert (done.exit_code, done.stdout) == (1, "")
    assert "error: 0 of 1 clients have joined 'robots-0' at tcp://127.0.0.1" in done.stderr


def test_a_warning_is_one_line(tmp_path: Path) -> None:
    """What the library warns of is told without the line of code that it came from."""
    entry = {"name": "box", "backend": "unclosable", "task": "any"}
    done = run("rollout", write_config(tmp_path, entry), "--steps", 5)
    assert done.returncode == 0
    (warning,) = [line for line in done.stderr.splitlines() if "the lid is stuck" in line]
    assert warning.startswith("warning: close() of env 'box-0' raised")
    assert "self." not in done.stderr
