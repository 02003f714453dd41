"""A group belongs to one event loop and one process; other uses are refused with a reason."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import uvloop
from kit.processes import stop
from patience import HANG

import rlightning_aio
from rlightning_aio import sync
from rlightning_aio.errors import EnvBusy, GroupClosed, RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

PROBE = {
    "name": "probe",
    "backend": "probe",
    "task": "x",
    "num_workers": 3,
    "envs_per_process": 3,
}
INLINE = {
    "name": "probe",
    "backend": "probe",
    "task": "x",
    "num_workers": 3,
    "placement": "inline",
}
LOOPS = pytest.mark.parametrize("new_loop", [asyncio.new_event_loop, uvloop.new_event_loop])


def run_in(loop: Callable[[], asyncio.AbstractEventLoop], main: Coroutine[Any, Any, Any]) -> Any:
    """Run in a new loop, like `asyncio.run`; after a long time it counts as hung."""
    with asyncio.Runner(loop_factory=loop) as runner:
        return runner.run(asyncio.wait_for(main, HANG))


async def use(group: rlightning_aio.EnvGroup) -> list[float]:
    batch, _ = await group.reset()
    batch, _ = await group.step(batch.respond(action=np.array([[0, 4.0]] * 3)))
    return batch.reward.tolist()


async def begun(group: rlightning_aio.EnvGroup) -> None:
    """Return a group that is initialised and has steps in progress."""
    await group.init()
    batch, _ = await group.reset()
    group.step_async(batch.respond(action=np.array([[0, 4.0]] * 3)))


@LOOPS
def test_use_from_another_loop_is_refused_and_closing_is_not(
    new_loop: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    """The error names the loop and says what to do; the fixtures check that nothing is left."""
    group = rlightning_aio.build_env_group(PROBE)
    run_in(new_loop, begun(group))
    expected = r"belongs to the event loop .*[Ll]oop running=False closed=True.*asyncio\.run\(\)"
    for use_again in (group.init, group.reset, group.collect_async, group["probe-0"].reset):
        with pytest.raises(RLightningError, match=expected):
            run_in(new_loop, use_again())
    with pytest.raises(RLightningError, match=expected):
        group.step_async(rlightning_aio.BatchedData([], []))
    run_in(new_loop, group.close())
    run_in(new_loop, group.close())
    with pytest.raises(GroupClosed):
        group.get_action_spaces()


@LOOPS
def test_a_loop_that_is_not_closed_may_be_used_again(
    new_loop: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    """Between its runs, plain code may send; another loop may close a group that tasks wait for."""
    group = rlightning_aio.build_env_group(PROBE)
    with asyncio.Runner(loop_factory=new_loop) as own:
        own.run(group.init())
        batch, _ = own.run(group.reset())
        with pytest.raises(RLightningError, match="is not running; use it there"):
            run_in(new_loop, group.reset())
        group.step_async(batch.respond(action=np.array([[0, 4.0]] * 3)))
        batch, _ = own.run(group.collect_async(wait_all=True))
        assert batch.reward.tolist() == [4.0] * 3
        pid = group.get_workers()[0]["pid"]
        stop(pid)
        group.step_async(batch.respond(action=np.array([[0, 4.0]] * 3)))

        async def begin() -> asyncio.Task[Any]:
            waiting = asyncio.ensure_future(group.collect_async())
            await asyncio.sleep(0)
            return waiting

        waiting = own.run(begin())
        os.kill(pid, signal.SIGCONT)
        run_in(new_loop, group.close())
        with pytest.raises(GroupClosed):
            own.run(asyncio.wait_for(waiting, HANG))


@pytest.mark.parametrize("kind", ["another loop", "no loop"])
def test_use_from_another_thread_is_refused_while_the_loop_runs(kind: str) -> None:
    """So is closing; the tasks of its own loop continue."""
    refused: list[BaseException] = []

    def elsewhere(group: rlightning_aio.EnvGroup) -> None:
        uses: list[Callable[[], Any]] = [
            lambda: group.step_async(rlightning_aio.BatchedData([], [])),
            group.reset_async,
        ]
        if kind == "another loop":
            uses = [lambda: asyncio.run(group.reset()), lambda: asyncio.run(group.close())]
        for use_there in uses:
            with pytest.raises(RLightningError) as caught:
                use_there()
            refused.append(caught.value)

    async def main() -> None:
        async with rlightning_aio.build_env_group(INLINE) as group:
            await asyncio.to_thread(elsewhere, group)
            assert await use(group) == [4.0] * 3

    asyncio.run(main())
    assert len(refused) == 2
    assert all("runs in another thread; pass work" in str(error) for error in refused)


def test_a_synchronous_group_is_one_thread_s_at_a_time() -> None:
    """While a thread waits in it, every call of another is refused; the first continues."""
    with sync.build_env_group(PROBE) as group:
        batch, _ = group.reset()
        worker = group.get_workers()[0]["pid"]
        stop(worker)
        group.step_async(batch.respond(action=np.array([[0, 4.0]] * 3)))
        found: list[Any] = []
        waiter = threading.Thread(target=lambda: found.append(group.collect_async(wait_all=True)))
        waiter.start()
        try:
            while not group._driver._thread:
                os.sched_yield()
            for ask in (group.reset, group.close, group.metrics, lambda: group.step_async(batch)):
                with pytest.raises(RLightningError, match=f"{waiter.ident} is using this group"):
                    ask()
        finally:
            os.kill(worker, signal.SIGCONT)
        waiter.join()
        assert found[0][0].reward.tolist() == [4.0] * 3


# -- errors in callbacks


class Broken:
    """Replaces `on_readable` of a source: raises a number of times, then calls the original."""

    def __init__(self, source: Any, times: int) -> None:
        self.times = times
        self.struck = asyncio.Event()
        self._read = source.on_readable
        source.on_readable = self

    def __call__(self) -> None:
        self.struck.set()
        if self.times:
            self.times -= 1
            raise MemoryError("none left")
        self._read()


def link_of(group: rlightning_aio.EnvGroup) -> Any:
    return group._core.supervisor.hosts[0]


@pytest.mark.parametrize("times", [1, 10**9])
def test_an_error_that_was_not_raised_yet_does_not_prevent_closing(times: int) -> None:
    """`close` closes first, then raises; a source that never reads is released by force."""

    async def main() -> None:
        group = rlightning_aio.build_env_group(PROBE)
        await group.init()
        link = link_of(group)
        broken = Broken(link, times)
        call = asyncio.ensure_future(group.call("get_attr", "label", env_ids=["probe-0"]))
        await asyncio.sleep(0)
        call.cancel()
        await broken.struck.wait()
        with pytest.raises(MemoryError):
            await group.close()
        await group.close()
        del link.on_readable

    asyncio.run(asyncio.wait_for(main(), HANG))


class Endless:
    """An awaitable env whose steps end when a test wants it."""

    action_space = gym.spaces.Discrete(2)
    goes_on: ClassVar[asyncio.Event]

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return "begun", {}

    async def step(self, action: Any) -> Any:
        await self.goes_on.wait()
        return "stepped", 0.0, False, False, {}


async def test_who_waits_for_a_busy_env_is_named() -> None:
    """The way out of an interrupted cell of IPython, whose task lives on."""
    Endless.goes_on = asyncio.Event()
    async with rlightning_aio.build_env_group(
        Endless, name="e", num_workers=1, placement="loop"
    ) as group:
        batch, _ = await group.reset()

        async def cell() -> None:
            await group.step(batch.respond(action=[0]))

        task = asyncio.create_task(cell(), name="Cell-7")
        await asyncio.sleep(0)
        assert group.pending
        for call in (group.reset, group.snapshot, lambda: group.step(batch.respond(action=[1]))):
            with pytest.raises(EnvBusy, match=r"'Cell-7' \(.*test_ownership.py:\d+\).*cancelled"):
                await call()
        (found,) = [one for one in asyncio.all_tasks() if one.get_name() == "Cell-7"]
        found.cancel()
        await asyncio.wait([task])
        Endless.goes_on.set()
        assert (await group.reset())[0].observation == ["begun"]

        Endless.goes_on.clear()
        group.step_async(batch.respond(action=[0]))
        task = asyncio.create_task(group.collect_async(), name="Cell-8")
        await asyncio.sleep(0)
        with pytest.raises(RLightningError, match="'Cell-8'"):
            await group.collect_async()
        with pytest.raises(EnvBusy, match=r"'Cell-8'.*drain"):
            await group.reset()
        Endless.goes_on.set()
        assert (await task)[0].observation == ["stepped"]


async def test_only_who_waits_for_the_busy_env_is_named() -> None:
    """Not who waits for others; of an agent, the task of the agent."""
    Endless.goes_on = asyncio.Event()
    fields: Any = {"name": "e", "num_workers": 3, "placement": "loop"}
    async with rlightning_aio.build_env_group(Endless, **fields) as group:
        batch, _ = await group.reset()
        steps = [batch.take([k]).respond(action=[0]) for k in range(3)]
        of_one, agent = group.step(steps[1]), group["e-2"].step(0)
        tasks = [asyncio.create_task(of_one, name="S"), asyncio.create_task(agent, name="A")]
        group.step_async(steps[0])
        while len(group.pending) < 3:  # noqa: ASYNC110  # Twice.
            await asyncio.sleep(0)
        for step, said in zip(
            steps, (r"replied yet; c", "in task 'S'", "in task 'A'"), strict=True
        ):
            with pytest.raises(EnvBusy, match=f"{said}[^']*$"):
                await group.step(step)
        Endless.goes_on.set()
        await asyncio.gather(*tasks)
