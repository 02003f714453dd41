"""What ``docs/command-line.md`` says can be typed."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

import pytest
from cli.command import TESTS, invoke, run

if TYPE_CHECKING:
    from pathlib import Path

ROOT = TESTS.parent
PAGE = (ROOT / "docs" / "command-line.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


LINES = [line.partition(" > ")[0] for block in blocks("sh") for line in block.splitlines()]


@pytest.mark.parametrize("line", LINES)
def test_every_command_runs(line: str, tmp_path: Path) -> None:
    """As it stands, with the page's policy in the folder where it is run."""
    (policy,) = blocks("python")
    (tmp_path / "my_policies.py").write_text(policy)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    done = run(*shlex.split(line)[1:], cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", re.findall(r"^## (\w+)$", PAGE, re.MULTILINE))
def test_every_option_is_one(command: str) -> None:
    """Each option named in a command's section is in its help."""
    section = PAGE.partition(f"\n## {command}\n")[2].partition("\n## ")[0]
    named = set(re.findall(r"--[a-z][a-z-]+", section))
    known = set(re.findall(r"--[a-z][a-z-]+", invoke(command, "--help").stdout))
    assert named - known == set()


def test_every_command_has_its_row() -> None:
    """The page lists what --help lists, and the two commands of env_server."""
    known = set(re.findall(r"^│ (\w+) ", invoke("--help").stdout, re.MULTILINE))
    rows = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE))))
    assert known <= rows
