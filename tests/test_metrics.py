"""The page about the numbers of a group; what it sends them to are the real libraries."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from test_docs import blocks, run_programs

if TYPE_CHECKING:
    from pathlib import Path


def test_the_programs_of_the_page_run(tmp_path: Path) -> None:
    """Means and percentiles are made, and a timeline is written."""
    pytest.importorskip("prometheus_client")
    first, means, _, prometheus, traced = blocks("python", "metrics.md")
    printed = run_programs([first, means, prometheus, traced], tmp_path)
    assert re.search(r"mean return: [1-9]", printed)
    assert re.search(r"p99 of a step: \[\d\S* \d\S*\]", printed)
    for name in ("steps", "idle", "seconds_in_envs", "outcomes_env_died"):
        assert re.search(rf"^envs/{name} ", printed, re.MULTILINE)
        assert f'rlightning{{name="envs/{name}"}}' in printed
    assert (tmp_path / "run.json").stat().st_size > 0
