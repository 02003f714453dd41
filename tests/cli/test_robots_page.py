"""The page about robot benchmarks, followed from its config to the table of success per task."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

import pytest
from cli.command import TESTS, run

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("metaworld")
pytestmark = pytest.mark.simulators

PAGE = (TESTS.parent / "docs" / "robots_evaluation.md").read_text()


def block(language: str) -> str:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)[0]


def test_the_page_ends_in_a_table_of_success(tmp_path: Path) -> None:
    """With its own config, policy and command, on fewer seeds, and without the plot."""
    (tmp_path / "arm.yaml").write_text(block("yaml"))
    (tmp_path / "my_policies.py").write_text(block("python"))
    lines = PAGE.replace("\\\n", "").splitlines()
    (line,) = [line for line in lines if "--plot success.png" in line]
    words = shlex.split(line.removeprefix("$ rlightning-aio ").replace(" --plot success.png", ""))
    done = run(*words, "--seeds", "0:2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = {words[0]: words[1:3] for words in map(str.split, done.stdout.splitlines()) if words}
    for task in ("reach-v3", "push-v3", "door-open-v3"):
        assert table[task] == ["2", "100.0%"]
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 1 + 6
