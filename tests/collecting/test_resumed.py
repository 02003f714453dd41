"""A new collector goes on from a snapshot as the old one would have."""

from __future__ import annotations

from typing import Any

import numpy as np

from rlightning_aio import sync
from rlightning_aio.collecting import Collector

POLES = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 3}


class Policy:
    """Its state changes with each result that it is shown. Episodes are short."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, batch: Any) -> Any:
        self.count += len(batch)
        return (batch.observation[:, 1] < 0.01 * (self.count % 60)).astype(int)


def test_what_follows_is_the_same_bit_for_bit() -> None:
    """Also where episodes had ended with the last rollout."""
    options: dict[str, Any] = {"num_transitions": 60, "wait_all": True}
    with sync.build_env_group(POLES) as group:
        policy = Policy()
        collector = Collector(group, policy, seed=0, **options)
        while not collector.collect().done[-1].any():
            pass
        kept, count = group.snapshot(), policy.count
        expected = [collector.collect() for _ in range(3)]
    with sync.build_env_group(POLES) as group:
        policy = Policy()
        policy.count = count
        collector = Collector(group, policy, seed=1, **options)
        batch, _ = group.restore(kept)
        collector.restart(batch=batch)
        found = [collector.collect() for _ in range(3)]
    for one, other in zip(found, expected, strict=True):
        for name in ("observation", "action", "reward", "done", "index"):
            assert np.array_equal(one[name], other[name]), name
        for name in ("index", "total_reward", "length"):
            assert np.array_equal(one.episodes[name], other.episodes[name]), name
        assert len(one.episodes["index"])


def test_envs_of_different_shapes_are_resumed_too() -> None:
    """One policy for each entry, some envs with sub-environments."""
    both = [POLES, {**POLES, "name": "many", "num_envs": 2}]
    policies = {"pole": None, "many": None}
    with sync.build_env_group(both) as group:
        collector = Collector(group, policies, num_transitions=30, min_results=6)
        batch, _ = group.reset(seed=3)
        collector.restart(batch=batch)
        first = collector.collect()
    for name, one in batch.by_entry().items():
        found = first[name]
        shown = one.observation.reshape(-1, 4)
        for index, observation in zip(one.index.ravel(), shown, strict=True):
            (own, *_) = np.flatnonzero(found.index == index)
            assert np.array_equal(found.observation[own], observation)
