"""`placement: loop`: what awaitable envs may do wrong, and what no other place has."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
import warnings
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from hosts.awaited import (
    BIG,
    BIG_BYTES,
    BLOCK,
    CANCELLED,
    END,
    EXIT,
    GATE,
    HANG,
    IGNORE,
    INTERRUPT,
    OWN,
    RAISE,
    STEP,
    Scripted,
)
from hosts.beside_others import steps
from patience import HANG as LONG

import rlightning_aio as rl
import rlightning_aio.sync
from rlightning_aio._core.group.drivers.aio_driver import AioDriver
from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs
from rlightning_aio.errors import (
    ConfigError,
    EnvBusy,
    EnvHung,
    EnvRaised,
    EpisodeLost,
    NothingPending,
    StartFailed,
    WorkerDied,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.one_driver_for_each_place
EAGER: Any = getattr(asyncio, "eager_task_factory", None)
SOON = 0.3
"""A limit that is meant to pass. What answers beside it needs a few turns of the loop, which even a
machine with much else to do takes in that time; and a loop that is kept waiting prolongs it.
"""


@pytest.fixture(autouse=True)
async def fresh() -> AsyncIterator[None]:
    Scripted.built.clear()
    Scripted.closed.clear()
    Scripted.gates.clear()
    Scripted.at_gate.clear()
    Scripted.let_go = asyncio.Event()
    yield
    Scripted.let_go.set()
    await asyncio.sleep(0)


def entry(name: str = "e", placement: str = "loop", **fields: Any) -> dict[str, Any]:
    return {"name": name, "placement": placement, **OWN, **fields}


@pytest.fixture(params=["loop", "process"])
def place(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Both places with an event loop: this process's, and a worker's own for all of its envs."""
    if request.param == "loop":
        return {"placement": "loop"}
    return {"placement": "process", "envs_per_process": 100}


async def until_at_gate(*env_ids: str) -> None:
    while not Scripted.at_gate.issuperset(env_ids):  # noqa: ASYNC110  # Seldom more than twice.
        await asyncio.sleep(0)


# -- many at once


async def test_looks_for_late_requests_do_not_multiply(monkeypatch: pytest.MonkeyPatch) -> None:
    """One is planned at a time, also when a late request makes room for one that waits."""
    plan, planned = AwaitedEnvs._plan_look, list[bool]()

    def counted(self: Any) -> None:
        planned.append(self._look is None)
        plan(self)

    monkeypatch.setattr(AwaitedEnvs, "_plan_look", counted)
    fields: Any = {"max_concurrency": 1, "step_timeout": 0.05, "on_worker_death": "restart"}
    async with rl.build_env_group(entry(num_workers=3, max_restarts=9, **fields)) as group:
        batch, _ = await group.reset()
        with contextlib.suppress(EnvHung):
            await group.step(batch.respond(action=[HANG, STEP, HANG]))
        await group.drain()
    assert planned
    assert all(planned)


async def test_max_concurrency_limits_how_many_are_busy() -> None:
    """The others queue, first come, first served, which doesn't count as their time."""
    config = entry(num_workers=6, max_concurrency=2, step_timeout=0.4)
    async with rl.build_env_group(config) as group:
        batch, _ = await group.reset()
        gates = {env_id: asyncio.Event() for env_id in group.env_ids}
        Scripted.gates.update(gates)
        group.step_async(batch.respond(action=np.full(6, GATE)))
        opened: list[int] = []
        for pair in (("e-0", "e-1"), ("e-2", "e-3"), ("e-4", "e-5")):
            await until_at_gate(*pair)
            assert Scripted.at_gate == set(pair)
            await asyncio.sleep(0.2)
            opened.append(time.monotonic_ns())
            for env_id in pair:
                gates[env_id].set()
        batch, _ = await group.collect_async(wait_all=True)
        assert not batch.restarted.any()
        assert batch.observation[:, 2].tolist() == [1.0] * 6
        assert (batch.busy_ns[4:] < time.monotonic_ns() - opened[1]).all()


async def test_an_agent_is_woken_by_results_of_its_own_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However many agents wait: a result wakes its own, and the one that reads for all."""
    count, num_steps, woken = 60, 3, 0
    block: Any = AioDriver._block

    async def counted(self: Any, wait: Any) -> None:
        nonlocal woken
        await block(self, wait)
        woken += 1

    async def agent(env_id: str) -> None:
        async with group.episode(env_id) as env:
            for _ in range(num_steps):
                await env.step(GATE)

    async with rl.build_env_group(entry(num_workers=count)) as group:
        gates = {env_id: asyncio.Event() for env_id in group.env_ids}
        Scripted.gates.update(gates)
        agents = [asyncio.ensure_future(agent(env_id)) for env_id in group.env_ids]
        await until_at_gate(*group.env_ids)
        monkeypatch.setattr(AioDriver, "_block", counted)
        for _ in range(num_steps):
            for env_id, gate in gates.items():
                gate.set()
                while env_id in Scripted.at_gate:  # noqa: ASYNC110  # Seldom more than twice.
                    await asyncio.sleep(0)
                gate.clear()
                for _ in range(20):
                    await asyncio.sleep(0)
        await asyncio.gather(*agents)
    assert woken <= 3 * count * num_steps


@pytest.mark.parametrize("action", [HANG, IGNORE], ids=["hangs", "ignores it"])
@pytest.mark.parametrize("leave", ["cancelled", "timeout", "exception", "caught"])
async def test_an_episode_that_is_left_during_a_step_leaves_its_env_idle(
    place: dict[str, Any], leave: str, action: int
) -> None:
    """At once, though the step would never end. Its env is replaced; no other notices anything."""
    sent = asyncio.Event()

    async def until_sent() -> None:
        while "e-0" not in group.pending:  # noqa: ASYNC110  # Twice.
            await asyncio.sleep(0)
        sent.set()

    async def expire(limit: asyncio.Timeout) -> None:
        await until_sent()
        limit.reschedule(0)

    async def agent() -> None:
        async with group.episode("e-0", seed=3) as env:
            await env.step(STEP)
            if leave in ("timeout", "caught"):
                caught = TimeoutError if leave == "caught" else ()
                with contextlib.suppress(caught):
                    async with asyncio.timeout(None) as limit:
                        expiring = asyncio.ensure_future(expire(limit))
                        await env.step(action)
                await expiring
                return
            async with asyncio.TaskGroup() as tasks:
                step = tasks.create_task(env.step(action))
                await until_sent()
                if leave == "exception":
                    raise ZeroDivisionError
                await step

    async with rl.build_env_group(entry(num_workers=2, **place)) as group:
        batch, _ = await group.reset(env_ids=["e-1"])
        running = asyncio.ensure_future(agent())
        await sent.wait()
        group.step_async(batch.respond(action=[STEP]))
        if leave == "cancelled":
            running.cancel()
        (outcome,) = await asyncio.gather(running, return_exceptions=True)
        assert {
            "cancelled": asyncio.CancelledError,
            "timeout": TimeoutError,
            "exception": ExceptionGroup,
            "caught": type(None),
        }[leave] is type(outcome)
        assert group.pending == ["e-1"]
        batch, _ = await group.collect_async()
        assert batch.observation.tolist() == [[1, 1, 1, -1]]
        batch, _ = await group.step(steps(e_0=STEP, e_1=STEP))
        assert batch.restarted.tolist() == [True, False]
        assert batch.observation.tolist() == [[2, 1, 0, 3], [1, 1, 2, -1]]
        assert group.get_workers()[0]["restarts"] == 0


@pytest.mark.parametrize("end", [{"abort": ()}, {"drain": (0.01,)}], ids=["abort", "drain"])
@pytest.mark.parametrize("what", ["step", "call"])
async def test_an_episode_tells_that_another_task_has_aborted_it(
    what: str, end: dict[str, tuple[float, ...]]
) -> None:
    """It is over, and further steps of it are refused."""
    async with rl.build_env_group(entry()) as group, group.episode("e-0", seed=3) as episode:
        Scripted.gates["e-0"] = asyncio.Event()
        asked = episode.step(HANG) if what == "step" else episode.call("wait")
        asking = asyncio.ensure_future(asked)
        while not group.get_workers()[0]["owed"]:  # noqa: ASYNC110  # Twice.
            await asyncio.sleep(0)
        ((name, arguments),) = end.items()
        await getattr(group, name)(*arguments)
        with pytest.raises(EpisodeLost, match=f"the {what} of env 'e-0'"):
            await asking
        assert episode.is_over
        assert episode.lost is not None
        assert (episode.lost.kind, episode.lost.cause) == ("cancelled", "was aborted")
        with pytest.raises(EpisodeLost, match="is lost: its env was aborted"):
            await episode.step(STEP)
        assert group.pending == []


async def test_steps_that_have_not_begun_are_aborted_as_well() -> None:
    """Of envs that queue, or that are just being rebuilt."""
    config = entry(num_workers=3, max_concurrency=1)
    async with rl.build_env_group(config) as group:
        await group.reset()
        group.step_async(steps(e_0=HANG, e_1=STEP, e_2=STEP))
        await group.abort(["e-1"])
        assert group.pending == ["e-0", "e-2"]
        await group.abort(["e-0"])
        batch, _ = await group.collect_async()
        assert batch.ids() == ["e-2"]
        for _ in range(3):
            group.step_async(steps(e_0=HANG))
            await group.abort()
        batch, _ = await group.step(steps(e_0=STEP, e_1=STEP, e_2=STEP))
        assert batch.restarted.tolist() == [True, True, False]


async def test_a_call_that_waits_for_an_env_learns_that_it_was_aborted(
    place: dict[str, Any],
) -> None:
    """With the results of the others; a collector waits for the rest, or has nothing pending."""
    async with rl.build_env_group(entry(num_workers=3, **place)) as group:
        batch, _ = await group.reset()
        stepping = asyncio.ensure_future(group.step(steps(e_0=STEP, e_1=HANG)))
        await asyncio.sleep(0)
        group.step_async(batch.take([2]).respond(action=[HANG]))
        collecting = asyncio.ensure_future(group.collect_async())
        await asyncio.sleep(0)
        await group.abort(["e-1", "e-2"])
        with pytest.raises(EpisodeLost, match=r"the step of env 'e-1'.* was aborted") as aborted:
            await stepping
        assert aborted.value.results.ids() == ["e-0"]
        with pytest.raises(NothingPending):
            await collecting
        batch, _ = await group.reset()
        assert batch.observation[:, 0].tolist() == [1, 2, 2]


async def test_a_step_that_is_cancelled_and_tried_again_leaves_its_env_idle() -> None:
    """The second one is refused; the end of the episode waits for the first."""
    async with rl.build_env_group(entry(num_workers=1)) as group:
        gate = Scripted.gates["e-0"] = asyncio.Event()
        async with group.episode("e-0") as env:
            first = asyncio.ensure_future(env.step(GATE))
            await until_at_gate("e-0")
            first.cancel()
            with pytest.raises(EnvBusy, match="has not replied yet"):
                await env.step(STEP)
            asyncio.get_running_loop().call_soon(gate.set)
        async with group.episode("e-0") as env:
            await env.step(STEP)


async def test_an_episode_that_is_cancelled_in_its_reset_leaves_its_env_idle() -> None:
    """Nothing leaves a context that was not entered yet."""

    class Opening(Plain):
        at_gate: ClassVar = asyncio.Event()
        gate: ClassVar = asyncio.Event()

        async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            self.at_gate.set()
            await self.gate.wait()
            return await super().reset(seed=seed, options=options)

    config = rl.EnvConfig(name="p", task=Opening, placement="loop")
    async with rl.build_env_group(config) as group:
        entering = asyncio.ensure_future(group.episode("p-0", seed=1).__aenter__())
        await Opening.at_gate.wait()
        entering.cancel()
        asyncio.get_running_loop().call_soon(Opening.gate.set)
        with pytest.raises(asyncio.CancelledError):
            await entering
        batch, _ = await group.reset(seed=2)
        assert batch.observation.tolist() == [2]


# -- envs that take too long


async def test_a_step_that_takes_too_long_is_cancelled_and_its_env_rebuilt(
    place: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    """The marked result is a reset of the new env with the same seed; the others don't notice."""
    async with rl.build_env_group(entry(num_workers=3, step_timeout=SOON, **place)) as group:
        await group.reset(seed=1)
        batch, _ = await group.step(steps(e_0=STEP, e_1=HANG, e_2=STEP))
        assert batch.restarted.tolist() == batch.is_reset.tolist() == [False, True, False]
        assert batch.truncated.tolist() == [False, True, False]
        assert batch.info("worker_restarted", "") == ["", "hung in a step and was cancelled", ""]
        assert batch.observation.tolist() == [[1, 1, 1, 1], [2, 1, 0, 2], [1, 1, 1, 3]]
        batch, _ = await group.step(steps(e_0=STEP, e_1=STEP, e_2=END))
        assert batch.observation[:, 2].tolist() == [2, 1, 2]
        assert not batch.restarted.any()
        assert group.get_workers()[0]["restarts"] == 1
    if place["placement"] == "loop":
        assert Scripted.closed[0] == "e-1"
        assert f"'e-1' took longer than {SOON} s for a step" in caplog.text
        assert "Scripted.step" in caplog.text


async def test_a_step_that_ends_as_its_time_is_up_has_one_end() -> None:
    """Its time is up in the turn of the loop before the one in which it would have ended."""
    async with rl.build_env_group(entry(step_timeout=SOON)) as group:
        batch, _ = await group.reset()
        gate = Scripted.gates["e-0"] = asyncio.Event()
        group.step_async(batch.respond(action=[GATE]))
        await until_at_gate("e-0")
        await asyncio.sleep(SOON)
        gate.set()
        time.sleep(SOON)  # noqa: ASYNC251  # The last timer and the gate are in one turn then.
        batch, _ = await group.collect_async()
        assert batch.restarted.all() or batch.observation[0, 2] == 1
        batch, _ = await group.step(steps(e_0=STEP))
        assert not batch.restarted.any()


async def test_time_during_which_the_event_loop_was_blocked_is_nobodys() -> None:
    """A policy that computes for longer than the limit costs no env its episode."""
    asyncio.get_running_loop().set_debug(False)  # It would keep what it warns of.
    async with rl.build_env_group(entry(num_workers=20, step_timeout=SOON)) as group:
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=np.full(20, STEP)))
        await asyncio.sleep(0)
        time.sleep(2 * SOON)  # noqa: ASYNC251
        batch, _ = await group.collect_async(wait_all=True)
        assert not batch.restarted.any()


async def test_the_event_loop_may_be_blocked_while_an_env_that_was_lost_begins_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The reset of the new env needs some turns of the loop, and time for them."""
    asyncio.get_running_loop().set_debug(False)  # It would keep what it warns of.
    began, reset = asyncio.Event(), Scripted.reset

    async def reset_in_turns(self: Scripted, **arguments: Any) -> rl.EnvRet:
        began.set()
        for _ in range(5):
            await asyncio.sleep(0)
        return await reset(self, **arguments)

    async with rl.build_env_group(entry(step_timeout=SOON, reset_timeout=SOON)) as group:
        await group.reset()
        monkeypatch.setattr(Scripted, "reset", reset_in_turns)
        stepping = asyncio.ensure_future(group.step(steps(e_0=HANG)))
        await began.wait()
        time.sleep(2 * SOON)  # noqa: ASYNC251
        batch, _ = await stepping
        assert batch.restarted.all()
        assert batch.observation[0, 0] == 2
        assert group.metrics()["envs/restarts"] == 1


async def test_a_reset_that_takes_too_long_is_repeated_by_a_new_env(place: dict[str, Any]) -> None:
    async with rl.build_env_group(entry(num_workers=2, reset_timeout=SOON, **place)) as group:
        batch, _ = await group.reset(seed=7, options={"hang": 1})
        assert batch.restarted.all()
        assert batch.observation.tolist() == [[2, 1, 0, 7], [2, 1, 0, 8]]


@pytest.mark.parametrize(("max_restarts", "after"), [(0, "reset"), (1, "step"), (0, "call")])
async def test_an_env_whose_tool_was_away_plays_on_when_it_is_back(
    place: dict[str, Any], max_restarts: int, after: str
) -> None:
    """However often it failed in a row; the episode that was lost is reported."""
    config = entry(num_workers=2, step_timeout=SOON, max_restarts=max_restarts, **place)
    async with rl.build_env_group(config) as group:
        await group.reset(seed=3)
        for failed in range(2):
            for _ in range(0 if failed else max_restarts):
                batch, _ = await group.step(steps(e_1=HANG))
                assert batch.restarted.all()
            with pytest.raises(EnvHung, match=f"{max_restarts + failed} restarts in a row"):
                await group.step(steps(e_1=HANG))
            if after == "call":  # It is answered by an env that has begun no episode.
                assert await group.call("get_attr", "episodes", env_ids=["e-1"]) == [0]
            if after != "reset":
                batch, _ = await group.step(steps(e_1=STEP))
                assert batch.is_reset.tolist() == [True]
            else:
                batch, _ = await group.reset(seed={"e-1": 4}, env_ids=["e-1"])
            assert batch.restarted.tolist() == [True]
            assert batch.observation[0, 1:].tolist() == [1, 0, 4]
        batch, _ = await group.step(steps(e_0=STEP, e_1=STEP))
        assert batch.observation[:, 2].tolist() == [1, 1]
        for _ in range(max_restarts):
            batch, _ = await group.step(steps(e_1=HANG))
            assert batch.restarted.all()


async def test_a_hang_that_is_raised_concerns_its_env_alone(place: dict[str, Any]) -> None:
    config = entry(num_workers=2, step_timeout=SOON, on_worker_death="raise", **place)
    async with rl.build_env_group(config) as group:
        batch, _ = await group.reset()
        with pytest.raises(EnvHung, match=rf"'e-1' took longer than {SOON} s for a step") as raised:
            await group.step(steps(e_0=STEP, e_1=HANG))
        assert raised.value.env_ids == ("e-1",)
        assert raised.value.results.ids() == ["e-0"]
        batch, _ = await group.step(steps(e_0=STEP, e_1=STEP))
        assert batch.restarted.tolist() == [False, True]
        assert batch.observation[0, 2] == 2


async def test_an_env_that_can_not_be_rebuilt_fails_its_requests_until_it_can() -> None:
    config = entry(step_timeout=SOON, max_restarts=2, env_kwargs={"builds": 1})
    async with rl.build_env_group(config) as group:
        await group.reset()
        for _ in range(2):
            with pytest.raises(WorkerDied, match=r"could not be rebuilt: .*no more of these"):
                await group.step(steps(e_0=HANG))
        Scripted.built.clear()
        batch, _ = await group.step(steps(e_0=STEP))
        assert batch.restarted.all()


async def test_a_step_that_ignores_its_cancellation_is_left_behind(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Its env is replaced all the same, and what it returns at last goes nowhere."""
    async with rl.build_env_group(entry(step_timeout=SOON)) as group:
        await group.reset()
        batch, _ = await group.step(steps(e_0=IGNORE))
        assert batch.restarted.all()
        assert "its step or reset goes on although it was cancelled" in caplog.text
        Scripted.let_go.set()
        for _ in range(5):
            await asyncio.sleep(0)
        batch, _ = await group.step(steps(e_0=STEP))
        assert batch.observation.tolist() == [[2, 1, 1, -1]]


async def test_an_env_that_is_replaced_takes_no_other_along() -> None:
    """Though the other's step left the queue when a call of the first had ended."""
    config = entry(num_workers=3, max_concurrency=2, step_timeout=SOON)
    async with rl.build_env_group(config) as group:
        await group.reset()
        gate = asyncio.Event()
        Scripted.gates.update(dict.fromkeys(group.env_ids, gate))
        calls = [asyncio.ensure_future(group[i].call("wait")) for i in ("e-0", "e-1")]
        await asyncio.sleep(0)
        group.step_async(steps(e_2=IGNORE))  # It queues.
        gate.set()
        await asyncio.gather(*calls)
        group.step_async(steps(e_0=HANG))
        batch, _ = await group.collect_async(wait_all=True, deadline=LONG)
        assert batch.restarted.tolist() == [True, True]


# -- what they raise, and what they leave


async def test_a_cancelled_error_of_its_own_is_an_error_of_the_env(place: dict[str, Any]) -> None:
    """Nobody who waits is cancelled, and the env can be used again."""
    async with rl.build_env_group(entry(num_workers=2, **place)) as group:
        await group.reset()
        with pytest.raises(EnvRaised, match="CancelledError: its own"):
            await group.step(steps(e_0=CANCELLED, e_1=STEP))
        with pytest.raises(EnvRaised, match="ValueError: as it was asked to"):
            await group.step(steps(e_0=RAISE))
        with pytest.raises(EnvRaised, match="SystemExit: 5"):
            await group.step(steps(e_0=EXIT, e_1=STEP))
        batch, _ = await group.reset()
        assert batch.observation[:, 1].tolist() == [2, 2]


async def test_methods_may_be_coroutine_functions(place: dict[str, Any]) -> None:
    async with rl.build_env_group(entry(**place)) as group:
        assert await group["e-0"].call("double", 21) == 42


async def test_an_env_that_blocks_the_event_loop_is_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """By entry, env and duration, whether or not asyncio is in its debug mode; not each time."""
    asyncio.get_running_loop().set_debug(False)
    async with rl.build_env_group(entry("slow", num_workers=2)) as group:
        await group.reset()
        for _ in range(5):
            await group.step(steps(slow_0=STEP, slow_1=BLOCK))
    reports = [r for r in caplog.records if "blocked the event loop" in r.getMessage()]
    assert [report.levelno for report in reports] == [logging.WARNING] * 3
    for report in reports:
        args: Any = report.args
        env_id, entry_name, milliseconds, doing, _ = args
        assert (env_id, entry_name, doing) == ("slow-1", "slow", "step")
        assert milliseconds >= 120
    assert reports[-1].getMessage().endswith("every 100th such turn is logged")


async def test_an_interrupt_that_an_env_raises_in_a_worker_is_its_own() -> None:
    """Another env that shares the event loop stays in its step."""
    config = entry("m", "process", num_workers=2, envs_per_process=2, step_timeout=SOON)
    async with rl.build_env_group(config) as group:
        await group.reset()
        group.step_async(steps(m_0=INTERRUPT, m_1=HANG))
        with pytest.raises(EnvRaised, match=r"'m-0'.*KeyboardInterrupt"):
            await group.collect_async()
        batch, _ = await group.collect_async()
        assert batch.info("worker_restarted") == ["hung in a step and was cancelled"]


async def test_a_worker_waits_until_the_trainer_has_read_a_big_info() -> None:
    """Sent in parts, it comes as a whole, and what follows it as well."""
    config = entry("b", "process", num_workers=3, envs_per_process=3)
    async with rl.build_env_group(config) as group:
        await group.reset()
        for _ in range(3):
            group.step_async(steps(b_0=BIG, b_1=BIG, b_2=STEP))
            batch, _ = await group.collect_async(wait_all=True, deadline=LONG)
            sizes = [len(info.get("blob", b"")) for info in batch.info()]
            assert sizes == [BIG_BYTES, BIG_BYTES, 0]


# -- the end


@pytest.mark.parametrize("wrong", [{"close": "hangs"}, {}], ids=["close hangs", "step goes on"])
async def test_closing_ends_whatever_envs_do(wrong: dict[str, Any]) -> None:
    """Within the time that a group gives its hosts; the env is named in a warning."""
    group = rl.build_env_group(entry(num_workers=2, env_kwargs=wrong))
    await group.init()
    await group.reset()
    group.step_async(steps(e_1=STEP if wrong else IGNORE))
    if wrong:
        await group.collect_async()
    else:
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        await group.close()
    named = {str(w.message).split("'")[1] for w in caught}
    assert named == ({"e-0", "e-1"} if wrong else {"e-1"})
    assert sorted(Scripted.closed) == ["e-0", "e-1"]


async def test_a_close_waits_for_another_one() -> None:
    """The end of its loop would cut the other one short."""
    group = rl.build_env_group(entry(num_workers=2))
    await group.init()
    closing = asyncio.ensure_future(group.close())
    await asyncio.sleep(0)
    await group.close()
    assert len(Scripted.closed) == 2
    await closing


async def test_a_cancelled_start_leaves_nothing_running() -> None:
    group = rl.build_env_group(entry(num_workers=2000))
    starting = asyncio.create_task(group.init())
    for _ in range(3):
        await asyncio.sleep(0)
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting


# -- who may live there


class Plain:
    """Gymnasium's methods as coroutine functions, and no base class."""

    observation_space, action_space = spaces.Discrete(100), spaces.Discrete(9)
    total: int

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await asyncio.sleep(0)
        self.total = seed or 0
        return self.total, {"options": options}

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0)
        self.total += int(action)
        return self.total, float(action), self.total > 50, False, {}


async def test_an_object_with_gymnasiums_methods_will_do(place: dict[str, Any]) -> None:
    """Made by a callable, which need not be sent anywhere under `placement: loop`."""
    config = rl.EnvConfig(name="p", task=Plain, num_workers=3, **place)
    async with rl.build_env_group(config) as group:
        batch, _ = await group.reset(seed=10)
        with group.auto_reset(math.inf):
            for _ in range(30):
                batch, _ = await group.step(batch.respond(action=np.array([1, 5, 8])))
        assert batch.observation.tolist() == [40, 45, 0]


class Slotted:
    """As `Plain`, but without a dict of attributes."""

    __slots__ = ("total",)
    observation_space, action_space = spaces.Discrete(100), spaces.Discrete(9)
    reset, step = Plain.reset, Plain.step


@pytest.mark.parametrize("kind", [Plain, Slotted])
async def test_such_an_object_goes_on_where_its_snapshot_was_taken(
    kind: Any, place: dict[str, Any]
) -> None:
    config = rl.EnvConfig(name="p", task=kind, num_workers=2, **place)
    async with rl.build_env_group(config) as group:
        batch, _ = await group.reset(seed=0)
        batch, _ = await group.step(batch.respond(action=np.array([1, 2])))
        snapshot = await group.snapshot()
        await group.step(batch.respond(action=np.array([5, 5])))
        batch, _ = await group.restore(snapshot)
        assert batch.observation.tolist() == [1, 3]
        batch, _ = await group.step(batch.respond(action=np.array([1, 1])))
        assert batch.observation.tolist() == [2, 4]


def test_a_synchronous_group_has_no_event_loop_for_them() -> None:
    with pytest.raises(ConfigError, match="a synchronous group has no event loop for placement"):
        rlightning_aio.sync.build_env_group(entry())


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (entry() | {"backend": "gymnasium", "task": "CartPole-v1"}, "would block the event loop"),
        (entry(placement="inline"), "is awaitable"),
        (entry() | {"backend": "half awaitable"}, "must both be `async def`"),
    ],
    ids=["not awaitable", "inline", "half of it"],
)
async def test_an_env_that_does_not_suit_its_place_is_refused(
    config: dict[str, Any], message: str
) -> None:
    with pytest.raises(StartFailed, match=message):
        await rl.build_env_group(config).init()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"placement": "process", "max_concurrency": 3}, "max_concurrency: has no meaning"),
        ({"max_concurrency": 0}, "max_concurrency: should be greater"),
        ({"interpreter": "python3"}, "interpreter: has no meaning"),
    ],
    ids=str,
)
def test_fields_that_mean_nothing_there_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        rl.build_env_group({**entry(), **fields})


# -- event loops


class Ready(Plain):
    """Waits for nothing."""

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.total = 0
        return 0, {}

    async def step(self, action: Any) -> Any:
        self.total += int(action)
        return self.total, 1.0, False, False, {}


@pytest.mark.skipif(not EAGER, reason="tasks can be eager from Python 3.12 on")
async def test_a_loop_with_eager_tasks_will_do() -> None:
    """A step that waits for nothing does not end while it is being sent."""
    loop = asyncio.get_running_loop()
    fields = {"placement": "loop", "max_concurrency": 2, "step_timeout": LONG}
    config = rl.EnvConfig.model_validate({"name": "p", "task": Ready, "num_workers": 500, **fields})
    loop.set_task_factory(EAGER)
    try:
        async with rl.build_env_group(config) as group:
            batch, _ = await group.reset()
            for _ in range(3):
                batch, _ = await group.step(batch.respond(action=np.ones(500, int)))
            assert (batch.observation == 3).all()
    finally:
        loop.set_task_factory(None)
