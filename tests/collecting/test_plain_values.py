"""Columns of plain values after results of several batches were joined."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

import rlightning_aio as rl
from rlightning_aio.batch import joined
from rlightning_aio.collecting import Collector
from rlightning_aio.spaces import Anything


class Counting:
    """Observes lists of one length, which could all be stacked to an array; see `step`."""

    observation_space = spaces.Dict(
        word=Anything(), pair=spaces.Tuple([Anything(), spaces.Box(0, 99, (), np.float32)])
    )
    action_space = Anything()

    def _observation(self) -> dict[str, Any]:
        return {"word": ["count", self.count], "pair": ([self.count], self.count)}

    async def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.count = 0
        return self._observation(), {}

    async def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """End if the action says so."""
        self.count += 1
        return self._observation(), 1.0, action == "end", False, {}


def check(observation: Any) -> None:
    """Each row has values of one count, as they are."""
    numbers, exact = observation["pair"]
    for word, number, count in zip(observation["word"], numbers, exact.tolist(), strict=True):
        assert word == ["count", count]
        assert number == [count]
        assert type(word[1]) is int


async def test_blocks_hold_values_of_envs_that_are_reset_apart() -> None:
    """Results of those that were not are joined to the others' first observations."""

    def policy(batch: rl.BatchedData) -> dict[str, Any]:
        check(batch.observation)
        return {"action": ["end" if k == 1 else "on" for k in range(len(batch))]}

    config = rl.EnvConfig(name="c", task=Counting, num_workers=3, placement="loop")
    async with rl.build_env_group(config) as group:
        with group.auto_reset(math.inf):
            collector = Collector(group, policy, num_transitions=15, wait_all=True)
            for _ in range(2):
                rollout = await collector.collect()
                counts = [[word[1] for word in row] for row in rollout.observation["word"]]
                assert [row[1] for row in counts] == [0] * 5
                assert counts[0][0] in (0, 5)


async def test_joined_batches_keep_them() -> None:
    """Of several entries, too, though the arrays between them have other bounds."""

    class Other(Counting):
        observation_space = spaces.Dict(
            word=Anything(), pair=spaces.Tuple([Anything(), spaces.Box(-9, 99, (), np.float32)])
        )

    entries = [
        rl.EnvConfig(name=kind.__name__, task=kind, num_workers=2, placement="loop")
        for kind in (Counting, Other)
    ]
    async with rl.build_env_group(entries) as group:
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=["on"] * 4))
        later, _ = await group.collect_async(wait_all=True)
        both = joined([batch, later])
        check(both.observation)
        assert both.observation["pair"][1].dtype == np.float32
        check(both.take([5, 0]).observation)
