"""Groups that are built, used and closed one after the other leave nothing behind."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path

import numpy as np

import rlightning_aio as rl
from rlightning_aio import sync

ENVS = 8
STEPS = 50
ENTRY = {
    "name": "pole",
    "backend": "gymnasium",
    "task": "CartPole-v1",
    "num_workers": ENVS,
    "envs_per_process": ENVS // 2,
}


def step_all() -> None:
    """Step all envs of a synchronous group at once."""
    with sync.build_env_group(ENTRY) as group, group.auto_reset(500):
        batch, _ = group.reset(seed=0)
        for _ in range(STEPS):
            batch, _ = group.step(batch.respond(action=np.zeros(ENVS, np.int64)))


async def step_halves() -> None:
    """Step the half of a group that is ready first."""
    async with rl.build_env_group(ENTRY) as group:
        with group.auto_reset(500):
            batch, _ = await group.reset(seed=0)
            for _ in range(STEPS):
                group.step_async(batch.respond(action=np.zeros(len(batch), np.int64)))
                batch, _ = await group.collect_async(min_results=ENVS // 2)


def num_descriptors() -> int:
    return len([*Path("/proc/self/fd").iterdir()])


def test_groups_in_a_row_leak_nothing() -> None:
    """After six groups of both kinds there is no additional descriptor, and little memory.

    Processes and shared memory are checked after each test.
    """
    held: list[tuple[int, int]] = []
    tracemalloc.start()
    try:
        for _ in range(3):
            step_all()
            rl.run(step_halves())
            gc.collect()
            held.append((num_descriptors(), tracemalloc.get_traced_memory()[0]))
    finally:
        tracemalloc.stop()
    assert held[-1][0] <= held[0][0]
    assert held[-1][1] < held[0][1] + 100_000, held
