"""`auto_reset`: what it does, and refuses; that it does that always, random programs show."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

from rlightning_aio import BatchedData, PolicyResponse, sync

# Resets depend on results only, not on the driver.
pytestmark = pytest.mark.one_driver_for_each_place

DO_NOTHING, END, TRUNCATE = range(3)
ENTRY = {"name": "probe", "backend": "probe", "task": "x", "num_workers": 3}
IDS = [f"probe-{k}" for k in range(3)]


def responses(*ids: str, what: int = DO_NOTHING) -> BatchedData:
    return BatchedData(list(ids), [PolicyResponse(id_, [what, 1.0]) for id_ in ids])


def steps_of(batch: BatchedData) -> list[float]:
    return batch.observation[:, 2].tolist()


async def test_a_limit_of_three_has_a_period_of_four_calls(start: Any) -> None:
    """Two steps, the flagged third, then a reset with reward 0 and no flag in place of a fourth."""
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
                assert batch.truncated.tolist() == batch.limit_reached.tolist() == [flag] * 3
                assert not batch.terminated.any()
                # A reset in place of a step has no seed.
                assert (batch.observation[:, 3] == -1).all() == (period > 0 or call == 4)


@pytest.mark.parametrize("what", [END, TRUNCATE])
async def test_an_env_whose_episode_ended_is_reset(start: Any, what: int) -> None:
    """The next call resets it, without a flag; `on_done=False` leaves it to the caller."""
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


async def test_each_entry_has_its_own_limit(start: Any) -> None:
    """If an env has no limit, entering the context fails and names it."""
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
    """Each sub-environment has its own limit; the group's count cuts none of them."""
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


def test_a_limit_is_a_positive_int_or_infinite() -> None:
    """The error names any other value, and the context is not entered."""
    with sync.build_env_group({**ENTRY, "placement": "inline"}) as group:
        group.reset()
        for limit in (0, -3, 2.5, True, "7", -math.inf, math.nan):
            with pytest.raises(ValueError, match=f"positive int, or math.inf .*, not {limit!r}"):
                group.auto_reset(limit).__enter__()
        assert group.step(responses("probe-0"))[1] is None
        with group.auto_reset(np.int64(1)):
            assert group.step(responses("probe-0"))[1] == [True]


async def test_overriding_configured_limits_warns_once(start: Any) -> None:
    """The warning points at the caller's line, once for all envs; an equal limit gives none."""
    group = await start({**ENTRY, "max_episode_steps": 5})
    with pytest.warns(UserWarning, match="overrides") as caught, group.auto_reset(2):
        pass
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with group.auto_reset(5):
            pass
    with pytest.warns(UserWarning, match="steps=inf. overrides"), group.auto_reset(math.inf):
        pass


async def test_contexts_do_not_nest_and_an_exception_leaves(start: Any) -> None:
    """After an exception the context is left; `async with` behaves alike."""
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
