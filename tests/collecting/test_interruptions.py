"""Collectors that are cut off, whose envs raise, or whose group others use in between.

Nothing is lost or invented: each env's transitions are those that it must have made.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import types
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from combinations.features import copied, stored
from combinations.played import Uneven, act, played

import rlightning_aio as rl
from rlightning_aio.collecting import Collector
from rlightning_aio.errors import NothingPending

if TYPE_CHECKING:
    from collections.abc import Coroutine, Generator

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.collecting import Rollout

SEED = 7


class Awaited:
    """An awaitable `Uneven`, whose resets take some turns of the event loop, and steps one."""

    observation_space, action_space = Uneven.observation_space, Uneven.action_space

    def __init__(self, turns: int) -> None:
        self.env, self.turns = Uneven(), turns

    async def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        for _ in range(self.turns):
            await asyncio.sleep(0)
        return self.env.reset(seed=seed, options=options)

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0)
        return self.env.step(action)


def policy(batch: BatchedData) -> dict[str, Any]:
    return {"action": act("uneven", batch.observation), "seen": batch.observation}


async def awaited_policy(batch: BatchedData) -> dict[str, Any]:
    await asyncio.sleep(0)
    return policy(batch)


@types.coroutine
def cut_off(coroutine: Coroutine[Any, Any, Any], at: int) -> Generator[Any, Any, Any]:
    """Cancel a coroutine where it waits for the time `at`, counted from 0."""
    steps = coroutine.__await__()
    for count in itertools.count():
        try:
            waits_for = steps.send(None)
        except StopIteration as stop:
            return stop.value
        if count == at:
            steps.throw(asyncio.CancelledError())
        yield waits_for
    raise AssertionError


class Used:
    """What `stored` asks of the use of a group."""

    def __init__(self, size: int) -> None:
        self.size = size


def check(found: list[Rollout], size: int) -> None:
    """Each env has made its first transitions, each once and in order."""
    for k, own in enumerate(stored(Used(size), found)):
        (expected,) = played("uneven", "disabled", [SEED + k], math.inf, len(own))
        assert own == expected[: len(own)], f"env {k}"


def parts_of(rollout: Rollout | dict[str, Rollout]) -> list[Rollout]:
    """Copies of the rollouts that a collector has returned."""
    return [copied(one) for one in (rollout.values() if type(rollout) is dict else [rollout])]


async def collected(collector: Any, at: int, size: int) -> tuple[list[Rollout], int]:
    """Collect until each env has made a transition; the first two calls are cut off at `at`.

    Returns the rollouts, and how many calls were cut off.
    """
    found: list[Rollout] = []
    num_cut = 0
    while len(found) < 4 or len({*np.concatenate([one.index.flat for one in found])}) < size:
        collecting = collector.collect()
        try:
            found += parts_of(await (cut_off(collecting, at) if num_cut < 2 else collecting))
        except asyncio.CancelledError:
            num_cut += 1
    return found, num_cut


PER_ENTRY = {"fast": policy, "slow": policy}
AWAITED = dict.fromkeys(PER_ENTRY, awaited_policy)
WAYS: dict[str, tuple[Any, dict[str, Any]]] = {
    "one policy": (policy, {"num_transitions": 3}),
    "a policy for each entry": (PER_ENTRY, {"num_transitions": 3}),
    "awaitable policies": (AWAITED, {"num_transitions": 3}),
    "several results": (PER_ENTRY, {"num_transitions": 5, "min_results": 2}),
    "a block": (awaited_policy, {"num_transitions": 8, "wait_all": True}),
    "a block for each entry": (PER_ENTRY, {"num_transitions": 8, "wait_all": True}),
}


@pytest.mark.parametrize(
    ("way", "slow"),
    [*zip(WAYS, itertools.repeat("loop")), *zip(list(WAYS)[1::3], itertools.repeat("inline"))],
)
async def test_a_collect_goes_on_wherever_it_was_cancelled(way: str, slow: str) -> None:
    """As if it had not been: envs that are slow to reset included."""
    makers = {"fast": lambda: Awaited(0), "slow": lambda: Awaited(60)}
    entries = [
        {"name": name, "make_env": make, "num_workers": 2, "placement": "loop"}
        for name, make in makers.items()
    ]
    if slow == "inline":
        entries[1] |= {"make_env": Uneven, "placement": "inline"}
    answer, options = WAYS[way]
    for at in itertools.count():
        async with rl.build_env_group(entries) as group:
            with group.auto_reset(math.inf):
                collector: Any = Collector(group, answer, seed=SEED, **options)
                found, num_cut = await collected(collector, at, 4)
        check(found, 4)
        assert sum(map(len, found)) % options["num_transitions"] == 0
        if not num_cut:
            assert at > 1
            break


async def test_a_collect_of_workers_goes_on_wherever_it_was_cancelled() -> None:
    entry = {"make_env": Uneven, "envs_per_process": 2, "num_workers": 2}
    entries = [{**entry, "name": name} for name in PER_ENTRY]
    async with rl.build_env_group(entries) as group:
        for at in range(6):
            with group.auto_reset(math.inf):
                collector: Any = Collector(group, PER_ENTRY, num_transitions=3, seed=SEED)
                check((await collected(collector, at, 4))[0], 4)
            with contextlib.suppress(NothingPending):
                while True:
                    await group.collect_async(wait_all=True)
