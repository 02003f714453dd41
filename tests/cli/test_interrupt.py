"""Ctrl-C prints results so far, exits with 130 without a traceback, and leaves no process."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, line_with, run, start, write_config
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
    """Write a config of one env that writes its process id and then hangs."""
    pid_file = tmp_path / "pid"
    os.mkfifo(pid_file)  # Reading this pipe waits for the env.
    kwargs = {"pid_file": str(pid_file), "where": where}
    entry = {"name": "stuck", "backend": "stuck", "task": "any", "env_kwargs": kwargs}
    return write_config(tmp_path, entry), pid_file


def interrupt(child: subprocess.Popen[str]) -> tuple[str, str]:
    """Press Ctrl-C. Return the rest of the command's output."""
    child.send_signal(signal.SIGINT)
    stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130, stderr
    assert "Traceback" not in stderr
    assert "Warning:" not in stderr  # A traceback has a line of code.
    return stdout, stderr


def is_alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("as_json", [False, True])
def test_ctrl_c_while_envs_start(tmp_path: Path, as_json: bool) -> None:
    """A start that hangs is abandoned, and its worker ends."""
    config, pid_file = stuck(tmp_path, "init")
    with start("rollout", config, *["--json"] * as_json) as child:
        worker = int(pid_file.read_text())
        stdout, _ = interrupt(child)
    assert not is_alive(worker)
    if as_json:
        assert json.loads(stdout)["interrupted"]
    else:
        assert stdout.startswith("Interrupted after 0 steps")


def test_ctrl_c_while_an_env_hangs_in_a_step(tmp_path: Path) -> None:
    """The summary has the steps before it, and the worker ends."""
    config, pid_file = stuck(tmp_path, "step")
    with start("rollout", config, "--json") as child:
        worker = int(pid_file.read_text())
        line_with(child, "collecting 10,000 steps")
        stdout, _ = interrupt(child)
    assert json.loads(stdout)["steps"] <= 2
    assert not is_alive(worker)


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_ctrl_c_while_results_are_always_ready(tmp_path: Path, placement: str) -> None:
    """It takes effect, and the summary has the results so far."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 8, "placement": placement})
    with start("rollout", config, "--steps", 10**9, "--json", "--min-results", 1) as child:
        line_with(child, "collecting")
        stdout, _ = interrupt(child)
    document = json.loads(stdout)
    assert document["interrupted"]
    assert document["steps"] == document["metrics"]["envs/steps"]


@pytest.mark.parametrize("calls", [300, 50_000, 150_000])
def test_ctrl_c_at_any_call(tmp_path: Path, calls: int) -> None:
    """The signal may arrive anywhere from the first option to the last line of the table."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2})
    script = tmp_path / "interrupt_at_a_call.py"
    script.write_text(INTERRUPT_AT_A_CALL)
    program = [sys.executable, str(script), str(calls)]
    done = run("rollout", config, "--steps", 10**9, program=program)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert "Warning:" not in done.stderr
