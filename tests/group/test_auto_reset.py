"""`auto_reset`: limits, and what it refuses; when an env is reset, random programs show."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

from rlightning_aio import BatchedData, PolicyResponse, sync

# Resets depend on results only, not on the driver.
pytestmark = pytest.mark.one_driver_for_each_place

ENTRY = {"name": "probe", "backend": "probe", "task": "x", "num_workers": 3}
IDS = [f"probe-{k}" for k in range(3)]


def responses(*ids: str) -> BatchedData:
    return BatchedData(list(ids), [PolicyResponse(id_, [0, 1.0]) for id_ in ids])


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


async def test_an_exception_leaves_the_context(start: Any) -> None:
    group = await start(ENTRY)
    await group.reset()

    async def fail() -> None:
        with group.auto_reset(1):
            await group.step(responses(*IDS))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await fail()
    batch, flags = await group.step(responses(*IDS))
    assert (batch.observation[:, 2].tolist(), flags) == ([2] * 3, None)
