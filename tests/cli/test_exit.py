"""Errors end a command with an exit code and one message, without a traceback."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from cli.command import CARTPOLE, COMMAND, invoke, run, write_config
from patience import HANG

from rlightning_aio.cli import bench

STUB = {"name": "stub", "backend": "stub", "task": "any"}


def test_a_wrong_config_shows_no_traceback(tmp_path: Path) -> None:
    """Stderr has one line."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": -1})
    done = run("rollout", config)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "num_workers" in done.stderr


POLICIES = {
    "nonsense": "should look like my_policies:greedy",
    "no_such_module:f": "No module named 'no_such_module'",
    "cli.stub_policies:nothing": "has no 'nothing'",
    "cli.stub_policies:not_callable": "is a int, neither a callable nor with a predict..",
}
QUEUES = {
    "--tasks a": "add --seeds 0:50",
    "--seeds 3:1": "should look like 0:50 or 1,2,5",
    "--seeds a": "should look like 0:50 or 1,2,5",
    f"--seeds {2**62}": "should look like 0:50 or 1,2,5",
    "--seeds 0:2 --episodes 3": "--episodes and --seed are for a number",
}
SWEEPS = {
    "num_workers": "should be FIELD=A,B",
    "num_workers=": "should be FIELD=A,B",
    "num_worker=1": "did you mean 'num_workers'",
    "num_workers=0": "num_workers: should be greater",
    "min_results=0": "should be a number from 1 on",
    "placement=ray": "its envs live elsewhere",
}
ADDRESSES = (
    *("robot", "tcp://robot", "tcp://:5555", "udp://robot:1", "tcp://robot:0", "tcp://robot:65536"),
)
SWITCHING = {"name": "many", "task": "cli.judged_env:Switching", "placement": "inline"}
SERVER = {"name": "robots", "backend": "env_server", "env_kwargs": {"connect_timeout": 0.01}}
REFUSED: list[tuple[str, dict[str, Any], str, str]] = [
    ("rollout", CARTPOLE, "--steps 0", "--steps"),
    ("rollout", CARTPOLE, "--min-results none", "--min-results"),
    ("rollout", CARTPOLE, "--nonsense", "--nonsense"),
    *(
        ("rollout", CARTPOLE, f"--policy {k}", f"--policy '{k}': .*{v}")
        for k, v in POLICIES.items()
    ),
    *((name, STUB, f"--seed {2**61 + 1}", str(2**61)) for name in ("rollout", "eval", "bench")),
    ("eval", STUB, "--resume absent/file", "can't be written"),
    *(("eval", SWITCHING, words, said) for words, said in QUEUES.items()),
    *(("bench", STUB, f"--sweep {sweep}", said) for sweep, said in SWEEPS.items()),
    *((name, STUB, "--plot plot.txt", "should end in") for name in ("bench", "eval")),
    *((name, STUB, "--plot absent/a.png", "no folder") for name in ("bench", "eval")),
    ("bench", {**STUB, "num_worker": 2}, "", "did you mean 'num_workers'"),
    # Clients choose where their envs live, and a plain loop can't stop hardware.
    ("bench", SERVER, "", "'robots'"),
    ("bench", {"name": "arm", "backend": "piper", "task": "any"}, "", "move something real"),
    *(("client", STUB, f"--connect {where}", f"{where!r}") for where in ADDRESSES),
    ("client", STUB, "--connect robot", "tcp://127.0.0.1:5555"),
]


@pytest.mark.parametrize(("command", "entry", "words", "said"), REFUSED)
def test_a_wrong_word_is_refused_before_anything_starts(
    tmp_path: Path,
    command: str,
    entry: dict[str, Any],
    words: str,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The message names the option or field, and what to do."""
    monkeypatch.setattr(bench, "_run_in_child", lambda work: work(lambda _: None))
    done = invoke(command, write_config(tmp_path, entry), *words.split())
    assert (done.exit_code, done.stdout) == (2, "")
    assert re.search(said, done.stderr)
    assert not {"starting", "measuring", "Traceback"} & {*done.stderr.split()}


RAISED = ("env 'robot-0'", "ZeroDivisionError: the floor is missing", "stub_envs.py")
UNBUILT = ("robot-0", "FileNotFoundError: no such robot", "stub_envs.py")
AWAY = ("no client has dialled in for robots-0/0 within 0.01 s",)
TOO_FEW = "--policy cli.stub_policies:too_few"
FAILED: list[tuple[str, dict[str, Any], str, str, tuple[str, ...]]] = [
    *(
        (command, {"backend": backend, "placement": place}, "", table, said)
        for place in ("process", "inline")
        for command, backend, table, said in (
            ("rollout", "raising", "2 steps in ", RAISED),
            ("check", "raising", "", RAISED),
            ("rollout", "unbuildable", "", UNBUILT),
        )
    ),
    (
        *("rollout", {"backend": "dying", "on_worker_death": "raise"}, "", "2 steps in "),
        ("'robot-0'", "exited with code 7"),
    ),
    ("check", {"backend": "dying"}, "", "", ("'robot-0'", "exited with code 7")),
    ("check", {"backend": "raising", "on_env_error": "restart"}, "", "", RAISED),
    ("client", {"backend": "unbuildable"}, "--connect tcp://127.0.0.1:9", "", UNBUILT),
    ("rollout", SERVER, "", "", AWAY),
    ("eval", SERVER, "", "", AWAY),
    *(
        (command, {**STUB, "placement": "inline", "num_workers": 3}, TOO_FEW, "", ("rows for a",))
        for command in ("rollout", "eval")
    ),
]


@pytest.mark.parametrize(("command", "entry", "words", "table", "said"), FAILED)
def test_what_fails_is_code_1_and_one_message(
    tmp_path: Path,
    command: str,
    entry: dict[str, Any],
    words: str,
    table: str,
    said: tuple[str, ...],
) -> None:
    """It names the env and the cause; the table has the results so far, if there are any."""
    config = write_config(tmp_path, {"name": "robot", "task": "any", **entry})
    done = invoke(command, config, *words.split())
    assert done.exit_code == 1
    assert done.stdout.startswith(table)
    assert bool(done.stdout) == bool(table)
    message = done.stderr.partition("error: ")[2]
    assert [one for one in said if one not in message] == []
    assert "Traceback" not in done.stderr
    assert "above" not in done.stderr


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


def test_a_missing_simulator_is_code_2_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message comes before any worker starts."""
    from rlightning_aio.registry import Backend

    monkeypatch.setattr(Backend, "is_installed", lambda self: False)
    done = invoke("rollout", write_config(tmp_path, CARTPOLE))
    assert done.exit_code == 2
    assert "pip install" in done.stderr


def test_an_exception_of_a_policy_shows_its_own_code(tmp_path: Path) -> None:
    """The traceback leaves out this library's code."""
    config = write_config(tmp_path, {**STUB, "placement": "inline"})
    done = invoke("rollout", config, "--policy", "cli.stub_policies:broken")
    assert (done.exit_code, done.stdout) == (1, "")
    message = done.stderr.partition("error: ")[2]
    assert message.startswith("the policy raised LookupError: no such weights\n")
    places = [line for line in message.splitlines() if line.startswith("  File ")]
    assert ["stub_policies.py" in place for place in places] == [True]


def test_a_warning_is_one_line(tmp_path: Path) -> None:
    """It leaves out the line of code that raised it."""
    entry = {"name": "box", "backend": "unclosable", "task": "any"}
    done = run("rollout", write_config(tmp_path, entry), "--steps", 5)
    assert done.returncode == 0
    (warning,) = [line for line in done.stderr.splitlines() if "the lid is stuck" in line]
    assert warning.startswith("warning: close() of env 'box-0' raised")
    assert "self." not in done.stderr


def test_the_largest_seed_is_taken(tmp_path: Path) -> None:
    for command, length in (("rollout", "--steps"), ("eval", "--episodes")):
        done = invoke(command, write_config(tmp_path, STUB), "--seed", 2**61, length, 2)
        assert done.exit_code == 0, done.stderr


@pytest.mark.parametrize("command", ["backends", "--version"])
def test_results_that_can_not_be_written_are_one_message(command: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, command], stdout=full, stderr=subprocess.PIPE, timeout=HANG, check=False
        )
    assert (done.returncode, done.stderr) == (2, b"error: [Errno 28] No space left on device\n")
