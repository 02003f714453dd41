"""What a restart of a collector needs, and how it goes on without envs that move hardware."""

from __future__ import annotations

import asyncio
import copy
import math
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from kit.driven import INLINE
from kit.scripted import Counts

from rlightning_aio.collecting import Collector, Rollout
from rlightning_aio.errors import EnvRaised, RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.batch import BatchedData


def parts_of(rollout: Rollout | dict[str, Rollout]) -> list[Rollout]:
    """Copies of the rollouts that a collector has returned."""
    return [
        copy.deepcopy(one) for one in (rollout.values() if type(rollout) is dict else [rollout])
    ]


class Numbered(Counts):
    """Observes [its number, the episode, the step]; raises an error for the action 1."""

    observation_space = gym.spaces.Box(-1, 9999, (3,), np.float64)

    def __init__(self, number: int) -> None:
        self.number = number

    def does(self, action: Any) -> None:
        if action == 1:
            raise LookupError("as it was told")

    def observed(self) -> Any:
        return np.array([self.number, self.resets, self.steps], np.float64)


def numbered() -> Any:
    """A group of two entries with two envs each."""
    entries = [
        {"name": name, "task": [lambda k=k: Numbered(k) for k in numbers], "num_workers": 2}
        for name, numbers in (("a", (0, 1)), ("b", (2, 3)))
    ]
    return INLINE.build(entries)


def failing(*numbers: int) -> Callable[[BatchedData], dict[str, Any]]:
    """A policy at whose action these envs raise in the third step of their first episode."""

    def act_or_fail(batch: BatchedData) -> dict[str, Any]:
        number, episode, step = batch.observation.T
        return {"action": (np.isin(number, numbers) & (episode == 1) & (step == 2)).astype(int)}

    return act_or_fail


def steps_of(found: list[Rollout]) -> dict[int, list[tuple[int, int]]]:
    """Episode and step of each env's transitions, in order. Each is one that it has made."""
    made: dict[int, list[tuple[int, int]]] = {number: [] for number in range(4)}
    for rollout in found:
        after = rollout.next_observation
        for place in np.ndindex(rollout.shape):
            number, episode, step = map(int, rollout.observation[place])
            assert after[place].tolist() == [number, episode, step + 1]
            assert rollout.first[place] or made[number][-1] == (episode, step - 1)
            made[number].append((episode, step))
    return made


class Reluctant(Numbered):
    """Raises in its first reset, if its number is 1 or 2."""

    is_willing = False

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if not self.is_willing and self.number in (1, 2):
            self.is_willing = True
            raise LookupError("not yet")
        return super().reset(seed=seed, options=options)


async def test_a_restart_needs_all_envs_and_no_call_in_progress() -> None:
    async with numbered() as group:
        collector: Any = Collector(group, failing(), num_transitions=4)
        batch, _ = await group.reset(env_ids=["a-0", "b-0", "b-1"])
        with pytest.raises(ValueError, match=r"no result of env 'a-1'"):
            collector.restart(batch=batch)
        with pytest.raises(ValueError, match="a seed is of a reset"):
            collector.restart(3, batch=batch)
        collecting = asyncio.create_task(collector.collect())
        await asyncio.sleep(0)
        with pytest.raises(RuntimeError, match="in progress"):
            collector.restart()
        await collecting


async def until_it_raises(collector: Any) -> None:
    while True:
        await collector.collect()


@pytest.mark.usefixtures("moving")
async def test_an_env_that_may_move_something_real_is_reset_by_nobody_else() -> None:
    """The others go on without it."""
    async with numbered() as group:
        with group.auto_reset(math.inf):
            collector: Any = Collector(group, failing(1), num_transitions=12)
            with pytest.raises(EnvRaised) as raised:
                await collector.collect()
            found = [copy.deepcopy(await collector.collect()) for _ in range(2)]
            assert 1 not in found[1].index
            group.reset_async(env_ids=[raised.value.env_id])
            found += [copy.deepcopy(await collector.collect()) for _ in range(4)]
            assert (2, 0) in steps_of(found)[1]


@pytest.mark.usefixtures("moving")
@pytest.mark.parametrize(("blocks", "numbers"), [(True, (1,)), (False, (0, 1, 2, 3))])
async def test_an_env_that_may_move_something_real_is_asked_for_where_it_is_needed(
    blocks: bool, numbers: tuple[int, ...]
) -> None:
    """A block needs all envs, and a chain one of them."""
    async with numbered() as group:
        with group.auto_reset(math.inf):
            policy = failing(*numbers)
            collector: Any = Collector(group, policy, num_transitions=12, wait_all=blocks)
            for _ in numbers:
                with pytest.raises(EnvRaised):
                    await until_it_raises(collector)
            asks = r"'a-\d'.*group\.reset_async\(env_ids=\['a-\d'\]"
            for _ in range(2):
                with pytest.raises(RLightningError, match=asks):
                    await collector.collect()
            group.reset_async(env_ids=["a-1"])
            assert len(await collector.collect()) in (3, 12)


@pytest.mark.usefixtures("moving")
async def test_a_first_reset_of_what_moves_is_repeated_only_if_asked_for() -> None:
    numbers = [lambda k=k: Reluctant(k) for k in range(2)]
    async with INLINE.build([{"name": "a", "task": numbers, "num_workers": 2}]) as group:
        collector: Any = Collector(group, failing(), num_transitions=4)
        with pytest.raises(EnvRaised):
            await collector.collect()
        for _ in range(2):
            with pytest.raises(RLightningError, match=r"'a-1'.*restart\(\)"):
                await collector.collect()
        collector.restart()
        assert len(await collector.collect()) == 4
