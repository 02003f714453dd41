"""`auto_reset`: the step limit, the ends of episodes, and what happens instead of a step."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from rlightning_aio import BatchedData, EnvRaised, PolicyResponse, sync

# What is reset is decided from results, however they came.
pytestmark = pytest.mark.one_driver_for_each_place

DO_NOTHING, END, TRUNCATE, RAISE = range(4)
ENTRY = {"name": "probe", "backend": "probe", "task": "x", "num_workers": 3}
IDS = [f"probe-{k}" for k in range(3)]


def responses(*ids: str, what: int = DO_NOTHING) -> BatchedData:
    return BatchedData(list(ids), [PolicyResponse(id_, [what, 1.0]) for id_ in ids])


def steps_of(batch: BatchedData) -> list[float]:
    return batch.observation[:, 2].tolist()


async def test_a_limit_of_three_has_a_period_of_four_calls(start: Any) -> None:
    """Two steps, the flagged third, and a reset with reward 0 and no flag in place of a fourth."""
    group = await start(ENTRY)
    batch, _ = await group.reset(seed=0)
    with group.auto_reset(max_episode_steps=3):
        for period in range(3):
            for call, flag in enumerate([False, False, True, False], 1):
                batch, flags = await group.step(responses(*IDS))
                assert flags == [flag] * 3
                assert batch.observation[:, 1].tolist() == [period + 1 + (call == 4)] * 3
                assert steps_of(batch) == [call % 4] * 3
                assert batch.reward.tolist() == [float(call != 4)] * 3
                assert not (batch.terminated | batch.truncated).any()
                # A reset in a step's place has no seed: episodes go on as they would.
                assert (batch.observation[:, 3] == -1).all() == (period > 0 or call == 4)


async def test_the_same_holds_for_what_is_collected(start: Any) -> None:
    """Each env has its own count, whoever comes first."""
    group = await start(ENTRY)
    batch, _ = await group.reset()
    calls = dict.fromkeys(IDS, 0)
    with group.auto_reset(max_episode_steps=2):
        group.step_async(responses(*IDS))
        while sum(calls.values()) < 40:
            batch, flags = await group.collect_async(min_results=2)
            for env_id, flag, steps in zip(batch.ids(), flags, steps_of(batch), strict=True):
                calls[env_id] += 1
                assert (flag, steps) == (calls[env_id] % 3 == 2, calls[env_id] % 3)
            group.step_async(responses(*batch.ids()))
        batch, _ = await group.collect_async(wait_all=True)
    assert len(batch) == 3


async def test_only_envs_of_the_batch_advance(start: Any) -> None:
    """The others' counters stand still, and a reset sets one to 0."""
    group = await start(ENTRY)
    await group.reset()
    with group.auto_reset(max_episode_steps=2):
        assert (await group.step(responses("probe-0", "probe-1")))[1] == [False, False]
        assert (await group.step(responses("probe-2", "probe-0")))[1] == [False, True]
        await group.reset(env_ids=["probe-1"])
        batch, flags = await group.step(responses(*IDS))
        assert flags == [False, False, True]
        assert steps_of(batch) == [0, 1, 2]
        await group["probe-2"].reset()
        batch, flags = await group.step(responses("probe-2"))
        assert (steps_of(batch), flags) == ([1], [False])


async def test_counters_run_outside_of_the_context_too(start: Any) -> None:
    """A limit that was passed is reached at once; nothing is reset after the context."""
    group = await start(ENTRY)
    await group.reset()
    for _ in range(3):
        _, flags = await group.step(responses(*IDS))
        assert flags is None
    with group.auto_reset(max_episode_steps=4):
        assert (await group.step(responses("probe-0")))[1] == [True]
    batch, flags = await group.step(responses("probe-0"))
    assert (steps_of(batch), flags) == ([5], None)
    with group.auto_reset(max_episode_steps=2):
        batch, flags = await group.step(responses("probe-1"))
        assert (steps_of(batch), flags) == ([4], [True])
        batch, flags = await group.step(responses("probe-1"))
        assert (steps_of(batch), flags) == ([0], [False])


@pytest.mark.parametrize("what", [END, TRUNCATE])
async def test_an_episode_that_ends_by_itself_is_begun_anew(start: Any, what: int) -> None:
    """By the next call, with no flag; `on_done=False` leaves it to the caller."""
    group = await start(ENTRY)
    await group.reset()
    with group.auto_reset(max_episode_steps=10):
        batch, flags = await group.step(responses("probe-1", what=what))
        assert flags == [False]
        assert (batch.terminated | batch.truncated).tolist() == [True]
        batch, flags = await group.step(responses(*IDS, what=what))
        assert (steps_of(batch), flags) == ([1, 0, 1], [False] * 3)
        assert batch.reward.tolist() == [1.0, 0.0, 1.0]
    await group.reset()
    with group.auto_reset(max_episode_steps=3, on_done=False):
        for steps, flag in ((1, False), (2, False), (3, True), (0, False)):
            batch, flags = await group.step(responses("probe-0", what=what))
            assert (steps_of(batch), flags) == ([steps], [flag])


@pytest.mark.parametrize("what", [END, TRUNCATE])
async def test_what_was_due_when_the_context_was_left_is_when_another_is_entered(
    start: Any, what: int
) -> None:
    """As with one for each rollout: no step goes on after an end, wherever that was seen."""
    group = await start(ENTRY)
    await group.reset()
    await group.step(responses("probe-0", what=what))  # Ends before there is any context.
    with group.auto_reset(max_episode_steps=3):
        batch, flags = await group.step(responses(*IDS, what=what))
        assert (steps_of(batch), flags) == ([0, 1, 1], [False] * 3)
        batch, flags = await group.step(responses(*IDS, what=what))
        assert (steps_of(batch), flags) == ([1, 0, 0], [False] * 3)
    with group.auto_reset(max_episode_steps=9, on_done=False):
        batch, _ = await group.step(responses("probe-0"))
        assert steps_of(batch) == [2], "an end is the caller's affair here"
    with group.auto_reset(max_episode_steps=2):
        batch, flags = await group.step(responses(*IDS))
        assert (steps_of(batch), flags) == ([0, 1, 1], [False] * 3)
        batch, flags = await group.step(responses(*IDS))
        assert (steps_of(batch), flags) == ([1, 2, 2], [False, True, True])
    batch, _ = await group.step(responses("probe-2"))
    assert steps_of(batch) == [3], "plain steps are plain"
    with group.auto_reset(max_episode_steps=4, on_done=False):
        batch, flags = await group.step(responses(*IDS))
        assert (steps_of(batch), flags) == ([2, 0, 4], [False, False, True])


async def test_limits_are_each_entrys_own(start: Any) -> None:
    """Without one everywhere, entering fails, and names the env that has none."""
    group = await start(
        [
            {**ENTRY, "num_workers": 1, "max_episode_steps": 1},
            {**ENTRY, "name": "long", "num_workers": 1, "max_episode_steps": 2},
        ]
    )
    await group.reset()
    with group.auto_reset():
        assert (await group.step(responses("probe-0", "long-0")))[1] == [True, False]
        assert (await group.step(responses("probe-0", "long-0")))[1] == [False, True]
    unlimited = await start([{**ENTRY, "max_episode_steps": 5}, {**ENTRY, "name": "b"}])
    with pytest.raises(ValueError, match=r"'b-0'.*max_episode_steps"), unlimited.auto_reset():
        pass


async def test_envs_that_reset_themselves_keep_to_their_limit(start: Any) -> None:
    """Each sub-environment in its own time: no count of the group's cuts any of them."""
    entry = {"name": "v", "backend": "gymnasium", "task": "CartPole-v1", "num_envs": 4}
    group = await start({**entry, "max_episode_steps": 9})
    batch, _ = await group.reset(seed=0)
    before, at_different_times = batch.done, False
    with group.auto_reset():
        for _ in range(60):
            batch, flags = await group.step(batch.respond(action=np.zeros((1, 4), int)))
            assert flags == [False]
            np.testing.assert_array_equal(batch.is_reset, before)
            before = batch.done
            at_different_times |= bool(before.any() and not before.all())
    assert at_different_times


def test_a_limit_is_a_positive_int() -> None:
    """Anything else is refused by value, and the context stays closed."""
    with sync.build_env_group({**ENTRY, "placement": "inline"}) as group:
        group.reset()
        for limit in (0, -3, 2.5, True, "7"):
            with pytest.raises(ValueError, match=f"positive int, not {limit!r}"):
                group.auto_reset(limit).__enter__()
        assert group.step(responses("probe-0"))[1] is None
        with group.auto_reset(np.int64(1)):
            assert group.step(responses("probe-0"))[1] == [True]


async def test_overriding_configured_limits_warns_once(start: Any) -> None:
    """At the line of the caller, however many envs there are; an equal limit says nothing."""
    group = await start({**ENTRY, "max_episode_steps": 5})
    with pytest.warns(UserWarning, match="overrides") as caught, group.auto_reset(2):
        pass
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with group.auto_reset(5):
            pass


async def test_contexts_do_not_nest_and_an_exception_leaves(start: Any) -> None:
    """Afterwards, steps are plain again; `async with` works alike."""
    group = await start(ENTRY)
    await group.reset()
    with group.auto_reset(1):
        await group.step(responses(*IDS))
        with pytest.raises(RuntimeError, match="nest"), group.auto_reset(2):
            pass
        assert (await group.step(responses(*IDS)))[1] == [False] * 3

    async def fail() -> None:
        with group.auto_reset(1):
            await group.step(responses(*IDS))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await fail()
    batch, flags = await group.step(responses(*IDS))
    assert (steps_of(batch), flags) == ([2] * 3, None)
    async with group.auto_reset(3):
        assert (await group.step(responses("probe-0")))[1] == [True]
    assert (await group.step(responses("probe-0")))[1] is None


async def test_a_step_that_raises_does_not_count(start: Any) -> None:
    """It was not completed."""
    group = await start(ENTRY)
    await group.reset()
    with group.auto_reset(2):
        await group.step(responses("probe-0"))
        with pytest.raises(EnvRaised):
            await group.step(responses("probe-0", what=RAISE))
        assert (await group.step(responses("probe-0")))[1] == [True]
        batch, _ = await group.step(responses("probe-0", what=RAISE))
        assert steps_of(batch) == [0], "the action of a reset is not looked at"
