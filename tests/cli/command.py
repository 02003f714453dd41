"""Runs the command as a user would, in a process of its own or in this one."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from patience import HANG
from typer.testing import CliRunner

from rlightning_aio.cli.app import app

if TYPE_CHECKING:
    from collections.abc import Sequence

COMMAND = [sys.executable, "-c", "from rlightning_aio.cli import main; main()"]
TESTS = Path(__file__).parent.parent
"""Where commands are run, so that `imports: [cli.stub_envs]` is found."""

CARTPOLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1"}


def write_config(folder: Path, *entries: dict[str, Any]) -> str:
    """Write a YAML file (JSON is YAML) with `entries`, which may use the stub envs."""
    path = folder / "config.yaml"
    document = {"imports": ["cli.stub_envs"], "envs": list(entries)}
    path.write_text(json.dumps(document))
    return str(path)


def invoke(*words: object) -> Any:
    """Run the command in this process. Return stdout, stderr and exit_code."""
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)


def invoke_json(*words: object) -> Any:
    """Run the command in this process with --json. Return the document."""
    done = invoke(*words, "--json")
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout)


def run(
    *words: object, cwd: Path = TESTS, program: Sequence[str] = COMMAND
) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own and wait for its end."""
    return subprocess.run(
        [*program, *map(str, words)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=HANG,
        check=False,
    )


def start(*words: object) -> subprocess.Popen[str]:
    """Start the command in a process of its own."""
    return subprocess.Popen(
        [*COMMAND, *map(str, words)],
        cwd=TESTS,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def line_with(child: subprocess.Popen[str], words: str) -> str:
    """Return the next line on stderr that contains `words`."""
    assert child.stderr is not None
    while words not in (line := child.stderr.readline()):
        assert line, "the command has ended"
    return line
