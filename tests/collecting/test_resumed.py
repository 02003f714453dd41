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
