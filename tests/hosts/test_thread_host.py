"""A new kind of host in one short module, `thread_host`, which nothing in the package depends on.

Here it runs in one group with processes and inline envs.
"""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest
from group.sample_envs import Probe
from hosts import beside_others, thread_host
from hosts.beside_others import (
    both_ways,
    check_first_ready,
    check_methods,
    check_three_are_equal,
    check_usable_after_an_error,
    steps,
)
from hosts.thread_host import EnvThread
from kit.driven import Place

import rlightning_aio.sync
from rlightning_aio import ENVS, PolicyResponse
from rlightning_aio._core.hosts import times
from rlightning_aio.errors import StartFailed
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


def test_it_is_short() -> None:
    """CONTRIBUTING.md promises fewer than 250 lines."""
    assert len(Path(thread_host.__file__).read_text().splitlines()) < 250


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


async def test_an_env_that_raises_stays_usable(facade: Place) -> None:
    """The result of its neighbour comes with the error, and both continue."""
    async with facade.build(entry("one", num_workers=2, envs_per_process=2)) as group:
        await check_usable_after_an_error(group)


async def test_results_out_of_band_are_copied(facade: Place) -> None:
    """The env changes its results in place, and earlier results don't change."""
    async with facade.build(entry("one", "reusing")) as group:
        await group.reset()
        results = [(await group.step(steps(one_0=0)))[0].values()[0] for _ in range(3)]
    assert [ret.info["nested"] for ret in results] == [{"list": [1]}, {"list": [2]}, {"list": [3]}]
    assert [ret.observation["items"][0].tolist() for ret in results] == [[1, 1], [2, 2], [3, 3]]


async def test_packed_infos_are_decoded(facade: Place) -> None:
    """A new schema is announced before its first info; options travel out of band."""
    async with facade.build(entry("one", "gymnasium", task="Tree-v0")) as group:
        batch, _ = await group.reset(seed=3, options={"nested": [1]})
        assert batch.values()[0].info == {"seed": 3, "options": {"nested": [1]}}
        (space,) = group.get_action_spaces()
        batch, _ = await group.step(steps(one_0=space.sample()))
        assert batch.values()[0].info["steps"] == 1


async def test_methods_are_called_in_the_thread(facade: Place) -> None:
    """Calls return values, and only the caller gets their errors."""
    async with facade.build([entry("one"), entry("two", placement="process")]) as group:
        await check_methods(group)


async def test_a_slow_env_does_not_delay_the_first_result(facade: Place, tmp_path: Path) -> None:
    """Ready results come first, from a thread, a process or inline."""
    await check_first_ready(facade, THREE_PLACES, "thread", tmp_path)


# -- beginnings and ends


async def test_an_env_that_cannot_be_built_is_named(facade: Place) -> None:
    """No thread is left, whatever state the other hosts are in."""
    fails = entry("bad", num_workers=3, envs_per_process=3, env_kwargs={"fails": 1})
    others = [entry(f"good_{place}", placement=place) for place in THREE_PLACES]
    group = facade.build([*others, fails])
    with pytest.raises(StartFailed, match=r"env 'bad-1'.* could not be built: RuntimeError: no"):
        await group.init()
    assert env_threads() == []


async def test_a_thread_that_cannot_be_started_fails_the_start(
    facade: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a process would."""

    def refuse(_: EnvThread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(EnvThread, "start", refuse)
    with pytest.raises(StartFailed, match="entry 'one': can't start new thread"):
        await facade.build(entry("one")).init()


async def test_a_thread_that_ends_while_it_starts_fails_the_start(
    facade: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No caller waits for its completions."""

    def attach(*_: Any) -> None:
        raise MemoryError("no more rows")

    monkeypatch.setattr(EnvThread, "attach", attach)
    with pytest.raises(StartFailed, match=r"'one-0'.* ended in MemoryError: no more rows"):
        await facade.build(entry("one")).init()


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


class Closing(Probe):
    """Logs its threads, and raises in `close`."""

    log: ClassVar[list[tuple[str, str]]] = []
    begun: ClassVar[threading.Event]
    may_continue: ClassVar[threading.Event]

    def step(self, policy_resp: PolicyResponse) -> Any:
        self.log.append((f"step {self.worker_index}", threading.current_thread().name))
        self.begun.set()
        assert self.may_continue.wait(60)
        return super().step(policy_resp)

    def close(self) -> None:
        self.log.append((f"close {self.worker_index}", threading.current_thread().name))
        if self.worker_index == 1:
            raise ValueError("stuck")


@pytest.fixture
def closing(monkeypatch: pytest.MonkeyPatch) -> type[Closing]:
    monkeypatch.setitem(ENVS._classes, "closing", Closing)
    Closing.log.clear()
    Closing.begun, Closing.may_continue = threading.Event(), threading.Event()
    return Closing


async def test_envs_are_closed_in_order_in_their_thread(
    facade: Place, closing: type[Closing]
) -> None:
    """Errors name the env."""
    group = facade.build(entry("one", "closing", num_workers=3, envs_per_process=2))
    with pytest.warns(UserWarning, match=r"close\(\) of env 'one-1' raised ValueError: stuck"):
        async with group:
            await group.reset()
    names = ["envs from slot 0 on", "envs from slot 1 on", "envs from slot 1 on"]
    closes = [("close 0", names[0]), ("close 1", names[1]), ("close 2", names[2])]
    assert sorted(closing.log) == closes
    assert closing.log.index(closes[1]) < closing.log.index(closes[2])


async def test_a_close_drops_requests_that_have_not_begun(closing: type[Closing]) -> None:
    """It waits for at most one step."""
    group = rlightning_aio.build_env_group(
        entry("one", "closing", num_workers=2, envs_per_process=2)
    )
    await group.init()
    batch, _ = await group.reset()
    group.step_async(batch.respond(action=np.zeros((2, 2))))
    await asyncio.to_thread(closing.begun.wait)
    task = asyncio.create_task(group.close())
    await asyncio.sleep(0)  # It has closed its hosts.
    closing.may_continue.set()
    with pytest.warns(UserWarning, match="stuck"):
        await task
    assert [event for event, _ in closing.log] == ["step 0", "close 0", "close 1"]


async def test_a_step_that_hangs_does_not_keep_a_group_from_closing(
    facade: Place, closing: type[Closing], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its thread continues, and releases its resources when it ends."""
    monkeypatch.setattr(times, "CLOSE", 0.05)
    monkeypatch.setattr(times, "GRACE", 0.05)
    monkeypatch.setattr(thread_host, "JOIN_SECONDS", 0.05)
    async with facade.build(entry("one", "closing")) as group:
        await group.reset()
        group.step_async(steps(one_0=[0.0, 0.0]))
        await asyncio.to_thread(closing.begun.wait)
    (thread,) = env_threads()
    closing.may_continue.set()
    thread.join()


def test_a_group_that_is_dropped_ends_its_threads() -> None:
    """It ends its workers in the same way."""
    groups = [rlightning_aio.sync.build_env_group(entry("one", num_workers=2))]
    groups[0].init()
    with pytest.warns(ResourceWarning, match="was not closed"):
        groups.clear()
    assert env_threads() == []
