"""The page about the numbers of a group; what it sends them to are the real libraries."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from test_docs import blocks, run_programs

if TYPE_CHECKING:
    from pathlib import Path


def test_the_page_tells_who_starves(tmp_path: Path) -> None:
    """In each of its three runs, the share that it names is the one that is large."""
    named = ("in_envs", "uncollected", "idle")
    least, printed = 0, ""
    for _ in range(20):
        printed = run_programs(blocks("python", "metrics.md")[1:2], tmp_path)
        runs = printed.split("slowest: ")[:3]
        found = [re.findall(r"^(\d+)% of .*: (\w+)$", run, re.MULTILINE) for run in runs]
        least = min(int(share) for k in range(3) for share, name in found[k] if name == named[k])
        if least > 50:
            break  # On a busy machine, all may wait for a core instead.
    assert least > 50
    second = re.match(r"Slow-2, (\S+) s", printed.split("slowest: ")[2])
    assert second is not None
    assert float(second[1]) >= 1


def test_the_programs_of_the_page_run(tmp_path: Path) -> None:
    """Means and percentiles are made, and a timeline is written."""
    pytest.importorskip("prometheus_client")
    first, _, means, _, prometheus, traced = blocks("python", "metrics.md")
    printed = run_programs([first, means, prometheus, traced], tmp_path)
    assert len(re.findall(r"mean return of the last [1-9]\d* episodes: [1-9]", printed)) == 3
    assert re.search(r"p99 of a step: \[\d\S* \d\S*\]", printed)
    for name in ("steps", "idle", "seconds_in_envs", "outcomes_env_died"):
        assert re.search(rf"^envs/{name} ", printed, re.MULTILINE)
        assert f'rlightning{{name="envs/{name}"}}' in printed
    assert (tmp_path / "run.json").stat().st_size > 0
