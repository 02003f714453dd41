"""Inline envs of several entries take turns."""

from __future__ import annotations

from collections import Counter

import numpy as np

import rlightning_aio.sync


def test_inline_entries_take_turns() -> None:
    """First come, first served: an env that gets a new request at once waits behind the others."""
    group = rlightning_aio.sync.build_env_group(
        [
            {
                "name": name,
                "backend": "gymnasium",
                "task": "CartPole-v1",
                "placement": "inline",
                "num_workers": 2,
                "max_episode_steps": 50,
            }
            for name in ("first", "second", "third")
        ]
    )
    came: Counter[str] = Counter()
    with group:
        batch, _ = group.reset(seed=0)
        with group.auto_reset():
            group.step_async(batch.respond(action=np.zeros(6, np.int64)))
            for _ in range(60):
                batch, _ = group.collect_async()
                came.update(list(batch.by_name()))
                group.step_async(batch.respond(action=np.zeros(len(batch), np.int64)))
    assert came == {"first": 20, "second": 20, "third": 20}
