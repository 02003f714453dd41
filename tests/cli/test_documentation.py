"""Commands in ``docs/command-line.md``, other pages and the README run."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

import pytest
from cli.command import TESTS, invoke, run
from run_python import blocks

if TYPE_CHECKING:
    from pathlib import Path

ROOT = TESTS.parent
PAGE = (ROOT / "docs" / "command-line.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


COMMANDS = [
    line.partition(" > ")[0]
    for page in PAGES
    for block in blocks("sh", page.read_text())
    for line in block.splitlines()
]
LINES = sorted({line for line in COMMANDS if line.startswith("rlightning-aio")})
# Looked at by test_documents.py, and run by test_docs.py.
ELSEWHERE = ("make ", "python -m rlightning_aio.legacy ")


SHORT = {
    "rollout": ["--steps", "500", "envs.0.num_workers=8"],
    "bench": ["--seconds", "0.005", "--rounds", "1", "envs.0.num_workers=1"],
    "eval": ["envs.0.num_workers=2"],
}


@pytest.mark.parametrize("line", LINES)
def test_every_command_runs(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each runs unchanged except for its length, with the page's policy in its folder."""
    (policy,) = blocks("python", PAGE)
    (tmp_path / "my_policies.py").write_text(policy)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    # Shorter runs with fewer envs save time.
    short = SHORT.get(shlex.split(line)[1], [])
    words = [*shlex.split(line)[1:], *short]
    if words[0] == "bench":  # It forks, which is for a process of its own.
        done = run(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    else:
        done = invoke(*words)
        assert done.exit_code == 0, done.stderr


def test_commands_that_cannot_run_are_console_blocks() -> None:
    """All others are `sh` blocks."""
    others = [line for line in COMMANDS if line not in LINES and line.strip()]
    assert [line for line in others if not line.startswith(ELSEWHERE)] == []


@pytest.mark.parametrize("command", re.findall(r"^## (\w+)$", PAGE, re.MULTILINE))
def test_every_option_of_the_page_exists(command: str) -> None:
    """Each is in the help of its section's command."""
    section = PAGE.partition(f"\n## {command}\n")[2].partition("\n## ")[0]
    named = set(re.findall(r"--[a-z][a-z-]+", section))
    known = set(re.findall(r"--[a-z][a-z-]+", invoke(command, "--help").stdout))
    assert named - known == set()


def test_every_command_is_on_the_page() -> None:
    """Each one that --help lists has a section."""
    known = set(re.findall(r"^│ (\w+) ", invoke("--help").stdout, re.MULTILINE))
    assert known == set(re.findall(r"^## (\w+)$", PAGE, re.MULTILINE))
