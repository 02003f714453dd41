"""A new kind of host in one short module, `thread_host`, which nothing in the package depends on.

Here it runs in one group with processes and inline envs.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hosts import beside_others, thread_host
from hosts.beside_others import (
    both_ways,
    check_three_are_equal,
    steps,
)
from hosts.thread_host import EnvThread
from kit.driven import Place

import rlightning_aio.sync
from rlightning_aio.registry import PLACEMENTS, Placement

if TYPE_CHECKING:
    from collections.abc import Iterator

CARTPOLE = {"task": "CartPole-v1", "max_episode_steps": 25}
THREE_PLACES = ("inline", "thread", "process")


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Register the host, and check that no thread of it outlives a test."""
    monkeypatch.setitem(
        PLACEMENTS, "thread", Placement("hosts.thread_host:ThreadHost", spreads=True)
    )
    yield
    assert env_threads() == []


FACADES = [Place("wherever", {}), Place("wherever", {}, synchronous=True)]


@pytest.fixture(params=FACADES, ids=["async", "sync"])
def facade(request: pytest.FixtureRequest) -> Place:
    """Groups of either facade, with awaitable methods; the entries choose the placement."""
    return request.param


def env_threads() -> list[EnvThread]:
    return [thread for thread in threading.enumerate() if isinstance(thread, EnvThread)]


def entry(name: str, backend: str = "probe", placement: str = "thread", **fields: Any) -> Any:
    return beside_others.entry(name, backend, placement, **fields)


# -- envs in a thread


async def test_trajectories_equal_those_of_inline_envs_and_processes(facade: Place) -> None:
    """They are equal to the last bit in one group, with both ways of waiting."""
    entries = [
        entry(place, "gymnasium", place, **CARTPOLE, num_workers=2, **apart)
        for place, apart in zip(
            THREE_PLACES, ({}, {"envs_per_process": 1}, {"envs_per_process": 1}), strict=True
        )
    ]
    draw = np.random.default_rng(0)
    resets = ends = 0
    async with facade.build(entries) as group:
        assert len(env_threads()) == 2
        batch, _ = await group.reset(seed={id_: 7 + int(id_[-1]) for id_ in group.env_ids})
        with group.auto_reset():
            for number in range(300):
                action = np.tile(draw.integers(0, 2, 2), 3)
                batch, flags = await both_ways(number, group, batch, action)
                check_three_are_equal(batch, flags)
                resets += int(np.sum(batch.is_reset))
                ends += int(np.sum(batch.terminated))
    assert resets > 30
    assert ends > 30


# -- beginnings and ends


async def test_a_thread_that_ends_is_replaced(
    facade: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A host gets restarts without code of its own: it posts `Died` and is started again."""
    async with facade.build(entry("one")) as group:
        await group.reset(seed=1)
        with monkeypatch.context() as patch:
            patch.delattr(thread_host, "execute")
            with pytest.raises(rlightning_aio.WorkerDied, match="ended in NameError"):
                await group["one-0"].call("double", 1)
        batch, _ = await group.step(steps(one_0=[0.0, 1.0]))
        assert batch.is_reset.all()
        assert batch.truncated.all()
        assert "ended in NameError" in batch.values()[0].info["worker_restarted"]
        batch, _ = await group.step(steps(one_0=[0.0, 1.0]))
        assert batch.reward.tolist() == [1]
        assert len(env_threads()) == 1
