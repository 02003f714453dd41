"""Rules for counting steps."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from cli import stub_envs
from cli.stub_envs import Stub
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio import EnvConfig, sync
from rlightning_aio.cli.rollout_statistics import RolloutStatistics

if TYPE_CHECKING:
    from rlightning_aio import BatchedData

assert stub_envs  # Importing it registers the envs.


def act(batch: BatchedData) -> BatchedData:
    return batch.respond(action=[0] * len(batch))


@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=3),
    num_workers=st.integers(1, 4),
    limit=st.integers(1, 8),
    collects=st.lists(st.tuples(st.integers(1, 12), st.integers(1, 12)), max_size=12),
)
def test_steps_are_actions_that_envs_have_executed(
    lengths: list[int], num_workers: int, limit: int, collects: list[tuple[int, int]]
) -> None:
    """Resets are left out, for any episode lengths, step limit and order of arrival."""
    configs = [
        EnvConfig(
            name=f"entry{index}",
            backend="stub",
            task="any",
            placement="inline",
            num_workers=num_workers,
            env_kwargs={"episode_length": length},
        )
        for index, length in enumerate(lengths)
    ]
    statistics = RolloutStatistics(configs)
    with sync.build_env_group(configs) as group:
        metas = {meta.env_id: meta for meta in group.init()}
        batch, _ = group.reset()
        Stub.steps = 0
        statistics.begin(metas.__getitem__)
        with group.auto_reset(limit):
            group.step_async(act(batch))
            for least, most in collects:
                batch, _ = group.collect_async(min_results=min(least, most), max_results=most)
                statistics.add(batch)
                group.step_async(act(batch))
            statistics.add(group.collect_async(wait_all=True)[0])
        stats = group.get_env_stats()
    assert statistics.steps == Stub.steps
    entries = statistics.by_entry(stats)
    assert sum(entry.steps for entry in entries) == statistics.steps
    for entry, length in zip(entries, lengths, strict=True):
        # The step limit ends an episode, too.
        expected = min(length, limit) if entry.episodes else None
        assert entry.mean_length == entry.mean_return == expected


def test_an_entry_without_results_has_no_figures() -> None:
    """They are None, because zero would be wrong."""
    config = EnvConfig(name="idle", backend="stub", task="any")
    idle: dict[str, Any] = {"episodes": 0, "mean_return": None, "mean_length": None}
    (figures,) = RolloutStatistics([config]).by_entry({"idle-0": idle})
    assert (figures.steps, figures.episodes) == (0, 0)
    assert figures.mean_return is None
    assert figures.step_us is None
    assert figures.steps_per_second == pytest.approx(0)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_losses_are_counted_by_cause(num_envs: int) -> None:
    """A step in flight is lost, a reset in flight is not; nothing of it counts as a step."""
    kwargs = {"episode_length": 3, "steps": 10}
    config = EnvConfig(
        name="a", backend="dying", task="any", num_workers=2, num_envs=num_envs, env_kwargs=kwargs
    )
    statistics = RolloutStatistics([config])
    with sync.build_env_group(config) as group:
        metas = {meta.env_id: meta for meta in group.init()}
        batch, _ = group.reset()
        statistics.begin(metas.__getitem__)
        with group.auto_reset(3):
            # In both envs, the second request and the fourth, a reset, are lost with the worker.
            for deaths in (False, True, False, False, False, True):
                for worker in group.get_workers() if deaths else ():
                    os.kill(worker["pid"], signal.SIGKILL)
                actions = np.zeros((2, num_envs), np.int64).squeeze()
                batch, _ = group.step(batch.respond(action=actions))
                statistics.add(batch)
        statistics.note_workers(group.get_workers())
        (figures,) = statistics.by_entry(group.get_env_stats())
    assert figures.steps == statistics.steps == 4 * 2 * num_envs
    assert (figures.restarts, figures.lost_steps) == (4, 2 * num_envs)
    ((cause, results),) = figures.losses.items()
    assert "SIGKILL" in cause
    assert results == 4
