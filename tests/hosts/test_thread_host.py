"""A new kind of host needs one short module; `thread_host` is it, and here it is put to use.

It stands beside processes and inline envs in one group, and nothing in the package knows it.
"""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest
from group.conftest import Place
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

import rlightning_aio.sync
from rlightning_aio import ENVS, PolicyResponse
from rlightning_aio.errors import StartFailed
from rlightning_aio.group import supervisor
from rlightning_aio.registry import PLACEMENTS, Placement

if TYPE_CHECKING:
    from collections.abc import Iterator

CARTPOLE = {"task": "CartPole-v1", "max_episode_steps": 25}
THREE_PLACES = ("inline", "thread", "process")


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """All that it takes to use the new host; and no thread of it outlives a test."""
    monkeypatch.setitem(
        PLACEMENTS, "thread", Placement("hosts.thread_host:ThreadHost", spreads=True)
    )
    yield
    assert env_threads() == []


FACADES = [Place("wherever", {}), Place("wherever", {}, synchronous=True)]


@pytest.fixture(params=FACADES, ids=["async", "sync"])
def facade(request: pytest.FixtureRequest) -> Place:
    """Groups of either facade, whose methods are awaited; the entries say where they live."""
    return request.param


def env_threads() -> list[EnvThread]:
    return [thread for thread in threading.enumerate() if isinstance(thread, EnvThread)]


def entry(name: str, backend: str = "probe", placement: str = "thread", **fields: Any) -> Any:
    return beside_others.entry(name, backend, placement, **fields)


def test_it_is_short() -> None:
    """CONTRIBUTING.md promises less than 250 lines."""
    assert len(Path(thread_host.__file__).read_text().splitlines()) < 250


# -- what envs do in a thread


async def test_trajectories_are_those_of_inline_envs_and_of_processes(facade: Place) -> None:
    """In one group, to the last bit, however results are waited for."""
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
    """Its neighbour's result comes with the error, and both go on."""
    async with facade.build(entry("one", num_workers=2, envs_per_process=2)) as group:
        await check_usable_after_an_error(group)


async def test_what_has_no_place_in_a_row_comes_beside_it(facade: Place) -> None:
    """Copied: the env changes in place what it returns, and earlier results stay as they were."""
    async with facade.build(entry("one", "reusing")) as group:
        await group.reset()
        results = [(await group.step(steps(one_0=0)))[0].values()[0] for _ in range(3)]
    assert [ret.info["nested"] for ret in results] == [{"list": [1]}, {"list": [2]}, {"list": [3]}]
    assert [ret.observation["items"][0].tolist() for ret in results] == [[1, 1], [2, 2], [3, 3]]


async def test_what_lies_packed_in_a_row_is_decoded(facade: Place) -> None:
    """A new form of an info is announced before the first that has it, options travel beside."""
    async with facade.build(entry("one", "gymnasium", task="Tree-v0")) as group:
        batch, _ = await group.reset(seed=3, options={"nested": [1]})
        assert batch.values()[0].info == {"seed": 3, "options": {"nested": [1]}}
        (space,) = group.get_action_spaces()
        batch, _ = await group.step(steps(one_0=space.sample()))
        assert batch.values()[0].info["steps"] == 1


async def test_methods_are_called_in_the_thread(facade: Place) -> None:
    """Values come back as they are; what a call raises is the caller's alone."""
    async with facade.build([entry("one"), entry("two", placement="process")]) as group:
        await check_methods(group)


async def test_the_first_result_is_not_kept_waiting_by_a_slow_env(
    facade: Place, tmp_path: Path
) -> None:
    """Whoever is ready comes first, from a thread, a process or inline."""
    await check_first_ready(facade, THREE_PLACES, "thread", tmp_path)


# -- beginnings and ends


async def test_an_env_that_cannot_be_built_is_named(facade: Place) -> None:
    """Nothing is left running, whatever the others were about."""
    fails = entry("bad", num_workers=3, envs_per_process=3, env_kwargs={"fails": 1})
    others = [entry(f"good_{place}", placement=place) for place in THREE_PLACES]
    group = facade.build([*others, fails])
    with pytest.raises(StartFailed, match=r"env 'bad-1'.* could not be built: RuntimeError: no"):
        await group.init()
    assert env_threads() == []


async def test_a_thread_that_the_system_refuses_fails_the_start(
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
    """Nobody waits for what it would have told."""

    def attach(*_: Any) -> None:
        raise MemoryError("no more rows")

    monkeypatch.setattr(EnvThread, "attach", attach)
    with pytest.raises(StartFailed, match=r"'one-0'.* ended in MemoryError: no more rows"):
        await facade.build(entry("one")).init()


async def test_a_thread_that_ends_is_replaced(
    facade: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restarts come for free: a host tells of its death, and is started again."""
    async with facade.build(entry("one")) as group:
        await group.reset(seed=1)
        with monkeypatch.context() as patch:
            patch.delattr(thread_host, "Value")
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
    """Says in which thread it does what, and raises in the end."""

    log: ClassVar[list[tuple[str, str]]] = []
    begun: ClassVar[threading.Event]
    may_go_on: ClassVar[threading.Event]

    def step(self, policy_resp: PolicyResponse) -> Any:
        self.log.append((f"step {self.worker_index}", threading.current_thread().name))
        self.begun.set()
        assert self.may_go_on.wait(60)
        return super().step(policy_resp)

    def close(self) -> None:
        self.log.append((f"close {self.worker_index}", threading.current_thread().name))
        if self.worker_index == 1:
            raise ValueError("stuck")


@pytest.fixture
def closing(monkeypatch: pytest.MonkeyPatch) -> type[Closing]:
    monkeypatch.setitem(ENVS._classes, "closing", Closing)
    Closing.log.clear()
    Closing.begun, Closing.may_go_on = threading.Event(), threading.Event()
    return Closing


async def test_envs_are_closed_in_order_in_their_thread(
    facade: Place, closing: type[Closing]
) -> None:
    """Errors are told with ids."""
    group = facade.build(entry("one", "closing", num_workers=3, envs_per_process=2))
    with pytest.warns(UserWarning, match=r"close\(\) of env 'one-1' raised ValueError: stuck"):
        async with group:
            await group.reset()
    names = ["envs from slot 0 on", "envs from slot 1 on", "envs from slot 1 on"]
    told = [("close 0", names[0]), ("close 1", names[1]), ("close 2", names[2])]
    assert sorted(closing.log) == told
    assert closing.log.index(told[1]) < closing.log.index(told[2])


async def test_what_has_not_begun_is_dropped(closing: type[Closing]) -> None:
    """Closing waits for one step at most."""
    group = rlightning_aio.build_env_group(
        entry("one", "closing", num_workers=2, envs_per_process=2)
    )
    await group.init()
    batch, _ = await group.reset()
    group.step_async(batch.respond(action=np.zeros((2, 2))))
    await asyncio.to_thread(closing.begun.wait)
    task = asyncio.create_task(group.close())
    await asyncio.sleep(0)  # It has told its hosts.
    closing.may_go_on.set()
    with pytest.warns(UserWarning, match="stuck"):
        await task
    assert [deed for deed, _ in closing.log] == ["step 0", "close 0", "close 1"]


async def test_a_step_that_hangs_does_not_keep_a_group_from_closing(
    facade: Place, closing: type[Closing], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its thread is left to itself, and gives back what it holds when it ends."""
    monkeypatch.setattr(supervisor, "_CLOSE_SECONDS", 0.05)
    monkeypatch.setattr(supervisor, "_KILL_SECONDS", 0.05)
    monkeypatch.setattr(thread_host, "JOIN_SECONDS", 0.05)
    async with facade.build(entry("one", "closing")) as group:
        await group.reset()
        group.step_async(steps(one_0=[0.0, 0.0]))
        await asyncio.to_thread(closing.begun.wait)
    (thread,) = env_threads()
    closing.may_go_on.set()
    thread.join()


def test_a_group_that_is_dropped_takes_its_threads_along() -> None:
    """As it does with workers."""
    groups = [rlightning_aio.sync.build_env_group(entry("one", num_workers=2))]
    groups[0].init()
    with pytest.warns(ResourceWarning, match="was not closed"):
        groups.clear()
    assert env_threads() == []
