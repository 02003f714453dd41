"""Collectors that begin anew, and whose envs raise.

Nothing is lost or invented: each env's transitions are those that it must have made.
"""

from __future__ import annotations

import asyncio
import copy
import inspect
import itertools
import math
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from kit.counting import ClientThread, CountingEnv
from kit.driven import INLINE, INLINE_SYNC, LOOP, SEVERAL, Place
from kit.scripted import Counts
from patience import HANG

import rlightning_aio as rl
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


# -- envs that raise, and groups that others use between two calls


class Numbered(Counts):
    """Observes [its number, the episode, the step]; raises an error for the action 1."""

    observation_space = gym.spaces.Box(-1, 9999, (3,), np.float64)

    def __init__(self, number: int) -> None:
        self.number = number

    def does(self, action: Any) -> None:
        if action == 1:
            raise LookupError("as it was told")

    def observed(self) -> Any:
        self.resets = self.options.get("episode", self.resets)
        return np.array([self.number, self.resets, self.steps], np.float64)


def numbered(place: Place, **fields: Any) -> Any:
    """A group of two entries with two envs each."""
    entries = [
        {
            "name": name,
            "task": [lambda k=k: Numbered(k) for k in numbers],
            "num_workers": 2,
            **fields,
        }
        for name, numbers in (("a", (0, 1)), ("b", (2, 3)))
    ]
    return place.build(entries)


def failing(*numbers: int) -> Callable[[BatchedData], dict[str, Any]]:
    """A policy at whose action these envs raise in the third step of their first episode."""

    def act_or_fail(batch: BatchedData) -> dict[str, Any]:
        number, episode, step = batch.observation.T
        return {"action": (np.isin(number, numbers) & (episode == 1) & (step == 2)).astype(int)}

    return act_or_fail


async def done(result: Any) -> Any:
    return await result if inspect.isawaitable(result) else result


def collector_of(group: Any, style: str, answer: Any, **options: Any) -> Any:
    """A collector of twelve transitions at a time."""
    answers = {"a": answer, "b": answer} if style.endswith("for each entry") else answer
    block = {"wait_all": True} if style.startswith("blocks") else options
    inner = getattr(group, "wrapped", group)
    return Collector(inner, answers, num_transitions=12, **block)


STYLES = ["chains", "chains for each entry", "blocks", "blocks for each entry"]


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


async def send_a_reset(group: Any, fault: EnvRaised) -> None:
    group.reset_async(env_ids=[fault.env_id])


async def send_a_reset_for_a_task(group: Any, fault: EnvRaised) -> None:
    group.reset_async(options={"episode": 500}, env_ids=[fault.env_id])


async def do_nothing(group: Any, fault: EnvRaised) -> None:
    """The collector resets it."""


GO_ON = [send_a_reset, send_a_reset_for_a_task, do_nothing]
RAISING = [
    *itertools.product([INLINE_SYNC], STYLES, GO_ON, [(1,)]),
    *itertools.product([LOOP, SEVERAL], STYLES[::3], GO_ON[:1], [(1,)]),
    *itertools.product([INLINE_SYNC], STYLES[::3], GO_ON[::2], [(0, 1, 2, 3)]),
]


@pytest.mark.parametrize(("place", "style", "go_on", "numbers"), RAISING)
async def test_an_env_that_raised_is_taken_back(
    place: Place, style: str, go_on: Any, numbers: tuple[int, ...]
) -> None:
    """From where it was reset, and also if it was the last one."""
    found: list[Rollout] = []
    raised: list[str] = []
    async with numbered(place) as group:
        with group.auto_reset(math.inf):
            collector = collector_of(group, style, failing(*numbers))
            # Which envs are served first is a matter of their processes.
            while len(found) < 8 or min(map(len, steps_of(found).values())) <= 4:
                try:
                    found += parts_of(await done(collector.collect()))
                except EnvRaised as fault:
                    raised.append(fault.env_id)
                    await go_on(group, fault)
    assert len(raised) == len(numbers)
    again = 500 if go_on is send_a_reset_for_a_task else 2
    for number, steps in steps_of(found).items():
        begun = 2 if number in numbers else len(steps)
        assert steps[:begun] == [(1, step) for step in range(begun)]
        assert steps[begun:] == [(again, step) for step in range(len(steps) - begun)]
        assert len(steps) > 4


class Reluctant(Numbered):
    """Raises in its first reset, if its number is 1 or 2."""

    is_willing = False

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if not self.is_willing and self.number in (1, 2):
            self.is_willing = True
            raise LookupError("not yet")
        return super().reset(seed=seed, options=options)


async def nothing(group: Any, collector: Any) -> None:
    collector.restart()


async def steps(group: Any, collector: Any) -> None:
    batch, _ = await group.reset()
    await group.step(batch.respond(action=np.zeros(4, int)))
    collector.restart()


async def requests(group: Any, collector: Any) -> None:
    """What they owe is dropped, be it a result or an error."""
    batch, _ = await group.reset()
    group.step_async(batch.respond(action=np.array([0, 1, 0, 0])))
    collector.restart()


async def a_reset(group: Any, collector: Any) -> None:
    await group.reset()
    collector.restart(batch=(await group.reset(options={"episode": 500}))[0])


async def a_restore(group: Any, collector: Any) -> None:
    kept = await group.snapshot()
    await group.reset()
    collector.restart(batch=(await group.restore(kept))[0])


BETWEEN = {
    nothing: (2, 0), steps: (3, 0), requests: (3, 0), a_reset: (500, 0), a_restore: (1, 3),
}  # fmt: skip
"""What a program does between two calls, and the episode and step with which they go on."""


@pytest.mark.parametrize("place", [INLINE_SYNC, LOOP])
@pytest.mark.parametrize("between", BETWEEN)
@pytest.mark.parametrize("style", STYLES)
async def test_a_restarted_collector_begins_where_it_is_told_to(
    style: str, between: Any, place: Place
) -> None:
    """All episodes anew, or from a batch; it has forgotten its own results."""
    found: list[Rollout] = []
    if place is LOOP and between is a_restore:
        pytest.skip("such envs have no snapshots")
    async with numbered(place) as group:
        with group.auto_reset(math.inf):
            collector = collector_of(group, style, failing(), min_results=4)
            found += parts_of(await done(collector.collect()))
            assert not group.pending
            await between(group, collector)
            for _ in range(2):
                found += parts_of(await done(collector.collect()))
    episode, step = BETWEEN[between]
    for steps in steps_of(found).values():
        assert steps[:3] == [(1, k) for k in range(3)]
        assert steps[3:] == [(episode, step + k) for k in range(len(steps) - 3)]
        assert len(steps) > 5


async def test_a_restart_needs_all_envs_and_no_call_in_progress() -> None:
    async with numbered(INLINE) as group:
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
    async with numbered(INLINE) as group:
        with group.auto_reset(math.inf):
            collector: Any = Collector(group, failing(1), num_transitions=12)
            with pytest.raises(EnvRaised) as raised:
                await collector.collect()
            found = [copy.deepcopy(await collector.collect()) for _ in range(2)]
            assert 1 not in found[1].index
            await send_a_reset(group, raised.value)
            found += [copy.deepcopy(await collector.collect()) for _ in range(4)]
            assert (2, 0) in steps_of(found)[1]


@pytest.mark.usefixtures("moving")
@pytest.mark.parametrize(("style", "numbers"), [("blocks", (1,)), ("chains", (0, 1, 2, 3))])
async def test_an_env_that_may_move_something_real_is_asked_for_where_it_is_needed(
    style: str, numbers: tuple[int, ...]
) -> None:
    """A block needs all envs, and a chain one of them."""
    async with numbered(INLINE) as group:
        with group.auto_reset(math.inf):
            collector = collector_of(group, style, failing(*numbers))
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


class Leaving(CountingEnv):
    """Raises in its third step, and leaves in its third step after that."""

    def step(self, policy_resp: Any) -> Any:
        if self.steps == 2 and self.resets == 1:
            raise LookupError("as it was told")
        self.finished = self.resets > 1 and self.steps == 2
        return super().step(policy_resp)


def still(batch: BatchedData) -> dict[str, Any]:
    return {"action": np.zeros((len(batch), 2), np.float32)}


@pytest.mark.parametrize("count", [1, 5])
async def test_clients_that_raised_or_came_back_are_taken_back(count: int) -> None:
    """Those that raised, once they were reset; those that left in a collect or between two."""
    kwargs = {"connect_timeout": HANG}
    server = {"name": "robots", "backend": "env_server", "env_kwargs": kwargs}
    async with rl.build_env_group(server) as group:
        address = group["robots-0"].address
        client = ClientThread(address, "c0", Leaving(0))
        with group.auto_reset(math.inf):
            collector: Any = Collector(group, still, num_transitions=count)
            found: list[Rollout] = []
            with pytest.raises(EnvRaised):
                await until_it_raises(collector)
            group.reset_async(seed=5, env_ids=["robots-0/0"])
            for _ in range(1 if count == 5 else 3):
                found += parts_of(await collector.collect())
            await asyncio.to_thread(client.join)
            back = ClientThread(address, "c0", CountingEnv(7))
            while found[-1].observation[0, 0] != 7:
                found += parts_of(await collector.collect())
    back.join()
    observed = np.concatenate([rollout.observation for rollout in found]).tolist()
    begun = [[0, -1, step] for step in range(2)] if count == 5 else []
    again = [[7, -1, step] for step in range(count)]
    assert observed == [*begun, *([0, 5, step] for step in range(3)), *again]
