"""Ctrl-C at any moment: what there is so far, exit code 130, no traceback, nobody left."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, run, start, write_config
from patience import HANG

if TYPE_CHECKING:
    import subprocess

INTERRUPT_AT_A_CALL = """
import os, signal, sys

left = int(sys.argv.pop(1))

def count_down(frame, event, argument):
    global left
    if event == "call":
        left -= 1
        if left == 0:
            sys.setprofile(None)
            os.kill(os.getpid(), signal.SIGINT)

import rlightning_aio.cli.app
from rlightning_aio.cli import main
sys.setprofile(count_down)
main()
"""


def stuck(tmp_path: Path, where: str) -> tuple[str, Path]:
    """A config of one env that says who it is and then hangs."""
    pid_file = tmp_path / "pid"
    os.mkfifo(pid_file)  # Reading it waits for the env.
    kwargs = {"pid_file": str(pid_file), "where": where}
    entry = {"name": "stuck", "backend": "stuck", "task": "any", "env_kwargs": kwargs}
    return write_config(tmp_path, entry), pid_file


def interrupt(child: subprocess.Popen[str]) -> tuple[str, str]:
    """Press Ctrl-C; all that the command still says."""
    child.send_signal(signal.SIGINT)
    stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130, stderr
    assert "Traceback" not in stderr
    assert "Warning:" not in stderr  # Python's way of showing one, with a line of code.
    return stdout, stderr


def is_alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("as_json", [False, True])
def test_while_envs_start(tmp_path: Path, as_json: bool) -> None:
    """A start that hangs is given up, and its worker is gone."""
    config, pid_file = stuck(tmp_path, "init")
    with start("rollout", config, *["--json"] * as_json) as child:
        worker = int(pid_file.read_text())
        stdout, _ = interrupt(child)
    assert not is_alive(worker)
    if as_json:
        assert json.loads(stdout)["interrupted"]
    else:
        assert stdout.startswith("Interrupted after 0 steps")


def test_while_an_env_hangs_in_a_step(tmp_path: Path) -> None:
    """The summary has the steps before it; the worker is gone."""
    config, pid_file = stuck(tmp_path, "step")
    with start("rollout", config, "--json") as child:
        worker = int(pid_file.read_text())
        assert child.stderr is not None
        while child.stderr.readline() != "collecting 10,000 steps\n":
            pass
        stdout, _ = interrupt(child)
    assert json.loads(stdout)["steps"] <= 2
    assert not is_alive(worker)


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_while_results_never_stop_coming(tmp_path: Path, placement: str) -> None:
    """Envs that are always ready leave Ctrl-C its turn; what came is summed up."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 8, "placement": placement})
    with start("rollout", config, "--steps", 10**9, "--json", "--min-results", 1) as child:
        assert child.stderr is not None
        while not child.stderr.readline().startswith("collecting"):
            pass
        stdout, _ = interrupt(child)
    document = json.loads(stdout)
    assert document["interrupted"]
    assert document["steps"] == document["entries"][0]["steps"]


@pytest.mark.parametrize("calls", [300, 50_000, 150_000])
def test_after_any_number_of_calls(tmp_path: Path, calls: int) -> None:
    """Wherever the code is when the signal comes, from the first option read to the last row."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2})
    script = tmp_path / "interrupt_at_a_call.py"
    script.write_text(INTERRUPT_AT_A_CALL)
    program = [sys.executable, str(script), str(calls)]
    done = run("rollout", config, "--steps", 10**9, program=program)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert "Warning:" not in done.stderr
