"""A new collector goes on from a snapshot as the old one would have."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlightning_aio import sync
from rlightning_aio.collecting import Collector

POLES = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 3}


def policy(batch: Any) -> Any:
    return (batch.observation[:, 1] < 0.3).astype(int)  # Episodes are short.


def test_what_follows_is_the_same_bit_for_bit() -> None:
    options: dict[str, Any] = {"num_transitions": 60, "wait_all": True}
    with sync.build_env_group(POLES) as group:
        collector = Collector(group, policy, seed=0, **options)
        collector.collect()
        kept = group.snapshot()
        expected = [collector.collect() for _ in range(3)]
    with sync.build_env_group(POLES) as group:
        collector = Collector(group, policy, seed=1, **options)
        group.restore(kept)
        found = [collector.collect() for _ in range(3)]
    for one, other in zip(found, expected, strict=True):
        for name in ("observation", "action", "reward", "done", "index"):
            assert np.array_equal(one[name], other[name]), name
        for name in ("index", "total_reward", "length"):
            assert np.array_equal(one.episodes[name], other.episodes[name]), name
        assert len(one.episodes["index"])


def test_a_partial_restore_is_no_start() -> None:
    """All envs are reset, with the seed of the collector."""
    with sync.build_env_group(POLES) as group:
        group.reset(seed=5)
        kept = group.snapshot(["pole-0"])
        collector = Collector(group, policy, num_transitions=3, min_results=3, seed=1)
        group.restore(kept, ["pole-0"])
        first = collector.collect().observation
    with sync.build_env_group(POLES) as group:
        batch, _ = group.reset(seed=1)
        assert np.array_equal(first, batch.observation)


def test_envs_of_different_shapes_are_resumed_too() -> None:
    """One policy for each entry, some envs with sub-environments."""
    both = [POLES, {**POLES, "name": "many", "num_envs": 2}]
    policies = {"pole": None, "many": None}
    with sync.build_env_group(both) as group:
        collector = Collector(group, policies, num_transitions=30, min_results=6)
        batch, _ = group.reset(seed=3)
        first = collector.collect()
    for name, one in batch.by_entry().items():
        found = first[name]
        shown = one.observation.reshape(-1, 4)
        for index, observation in zip(one.index.ravel(), shown, strict=True):
            (own, *_) = np.flatnonzero(found.index == index)
            assert np.array_equal(found.observation[own], observation)
