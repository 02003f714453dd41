"""The page about the numbers of a group; what it sends them to are the real libraries."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from test_docs import blocks, run_programs

if TYPE_CHECKING:
    from pathlib import Path


def test_the_page_tells_who_starves(tmp_path: Path) -> None:
    """In each of its three runs, the shares that it names are the ones that are large."""
    named = (
        {"waiting_for_envs", "in_envs"},
        {"waiting_to_be_collected"},
        {"in_trainer", "waiting_for_actions"},
    )
    least, printed = 0, ""
    for _ in range(20):
        printed = run_programs(blocks("python", "metrics.md")[1:2], tmp_path)
        runs = printed.split("slowest: ")[:3]
        shares = [re.findall(r"^(\d+)% of .*: (\w+)$", run, re.MULTILINE) for run in runs]
        assert [named[k] - {name for _, name in shares[k]} for k in range(3)] == [set()] * 3
        least = min(int(share) for k in range(3) for share, name in shares[k] if name in named[k])
        if least > 50:
            break  # On a busy machine, all may wait for a core instead.
    assert least > 50
    second = re.match(r"Slow-2, (\S+) s", printed.split("slowest: ")[2])
    assert second is not None
    assert float(second[1]) >= 0.1


def test_the_programs_of_the_page_run(tmp_path: Path) -> None:
    """Deaths are counted by entry, every library gets the numbers, and a timeline is written."""
    pytest.importorskip("prometheus_client")
    pytest.importorskip("opentelemetry.sdk.metrics")
    pytest.importorskip("tensorboardX")
    first, _, fails, board, _, prometheus, telemetry, traced = blocks("python", "metrics.md")
    printed = run_programs([first, fails, board, prometheus, telemetry, traced], tmp_path)
    assert "sound: 0 restarts, 0 episodes lost" in printed
    assert re.search(r"fragile: [4-9] restarts, [4-9] episodes lost", printed)
    sent = [r"^(envs/\w+) ", r"^(envs_\w+) ", r'"name": "(envs/\w+)"']
    found = [set(re.findall(pattern, printed, re.MULTILINE)) for pattern in sent]
    (curves,) = (tmp_path / "runs").iterdir()
    for name in ("steps", "idle", "seconds_in_envs", "outcomes_env_died"):
        assert {f"envs/{name}"} <= found[0] & found[2]
        assert f"envs_{name}" in found[1]
        assert f"envs/{name}".encode() in curves.read_bytes()
    assert (tmp_path / "run.json").stat().st_size > 0
