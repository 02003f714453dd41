"""Division of simulations over workers: evenly, and in few batches."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.sharing import num_batches, num_cores

if TYPE_CHECKING:
    from pathlib import Path


@given(total=st.integers(1, 3000), workers=st.integers(1, 128))
def test_no_worker_has_much_more_than_its_share(total: int, workers: int) -> None:
    """Batches have equal sizes, and their number is minimal."""
    count = num_batches(total, workers)
    assert total % count == 0
    best = -(-total // workers)
    loads = {n: -(-n // workers) * (total // n) for n in range(1, count + 1) if total % n == 0}
    assert loads[count] <= 1.15 * best
    assert all(load > 1.15 * best for n, load in loads.items() if n < count)


@pytest.mark.parametrize(
    ("limits", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "200000 100000\n"}, 2),
        ({"cpu.max": "250000 100000\n"}, 3),
        ({"cpu.max": "1000 100000\n"}, 1),
        ({"cpu.max": "9900000 100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
    ],
)
def test_a_container_s_limit_counts_as_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limits: dict[str, str], cores: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name, text in limits.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert num_cores(tmp_path) == cores
