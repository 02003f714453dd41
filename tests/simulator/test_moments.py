"""Moments that random programs seldom meet: exact times, and a trainer that was stopped meanwhile.

Each is brought about in a `World`, whose clock and processes do what the test wants.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock
from weakref import proxy

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import Counts
from simulator.world import Deadlock, World

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio._core.group.state.conditions import UNLIKE_ENVS
from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.messages import Lost
from rlightning_aio._core.hosts.process.host import ProcessHost
from rlightning_aio.errors import StartFailed, WorkerDied
from rlightning_aio.outcomes import Loss

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SEED = 2
"""Of a world in which nothing takes long by itself."""
FOR_EVER = 1e6
"""Seconds; longer than anything waits."""


class Timed(Counts):
    """A step takes as many seconds as its action says, and a reset as the option ``takes`` does."""

    action_space: Any = gym.spaces.Box(0, np.inf, (), np.float64)

    def does(self, action: Any) -> None:
        time.sleep(float(action))

    def observed(self) -> Any:
        if not self.steps:
            time.sleep(self.options.get("takes", 0))
        return super().observed()


@pytest.fixture
def world(implementation: str, request: pytest.FixtureRequest) -> Iterator[World]:
    """Yield a proxy, as pytest keeps what it gives to a test. Its parameter is the seed."""
    with World(getattr(request, "param", SEED), implementation=implementation) as world:
        yield proxy(world)


def entry(num_workers: int = 1, **fields: Any) -> rl.EnvConfig:
    place = {} if "placement" in fields else {"envs_per_process": 1}
    return rl.EnvConfig(name="e", num_workers=num_workers, **{"task": Timed, **place, **fields})


def built(config: rl.EnvConfig) -> Any:
    return sync.build_env_group(config)


def ask(group: Any, **seconds: float) -> None:
    """Send steps that take some time, to envs by their numbers."""
    ids = [f"e-{name[1:]}" for name in seconds]
    pairs = zip(ids, seconds.values(), strict=True)
    group.step_async(rl.BatchedData(ids, [rl.PolicyResponse(*pair) for pair in pairs]))


@contextmanager
def takes(world: World, least: float, most: float) -> Iterator[None]:
    """Check how long the context takes."""
    began = world.now_ns
    yield
    assert least <= (world.now_ns - began) / 1e9 <= most


def stopped_in(
    world: World, patch: pytest.MonkeyPatch, name: str, then: Callable[[Any], object] = id
) -> None:
    """The trainer is stopped for a minute when it has given this order to a host."""
    order = getattr(ProcessHost, name)

    def given(host: Any, *arguments: Any, **more: Any) -> None:
        order(host, *arguments, **more)
        then(host)
        world.sleep(60.0)

    patch.setattr(ProcessHost, name, given)


def stop_server_of(host: Any, seconds: float = FOR_EVER) -> None:
    """Stop the fork server of a host."""
    host._fork_server._server.process.stop(seconds)


def cause(batch: Any) -> list[str]:
    return [info.get("worker_restarted", "") for info in batch.info()]


# -- time limits


@pytest.mark.parametrize("begun", [0.0, 0.1, 1.9, 2.0, 3.3])
@pytest.mark.parametrize("is_stopped", [False, True])
def test_a_hang_is_ended_in_time(world: World, begun: float, is_stopped: bool) -> None:
    """When its time is over; of a worker that executes nothing, at most a quarter later."""
    with built(entry(2, step_timeout=8.0)) as group:
        group.reset()
        ask(group, e1=7.9)
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=begun or 1e-6)
        if is_stopped:
            (process,) = [p for p in world._processes if p.name == "worker 0"]
            process.stop(FOR_EVER)
        with takes(world, 8.0, 10.5 if is_stopped else 8.5):
            ask(group, e0=FOR_EVER)
            batch, _ = group.collect_async(wait_all=True)
        assert batch.restarted.tolist() == [True, False]


def test_a_hang_is_ended_though_an_earlier_worker_ended_before_its_kill(world: World) -> None:
    """It replied as its stacks were written, and its env went over to the next worker."""
    with built(entry(step_timeout=8.0, recycle={"episodes": 1})) as group:
        group.reset()
        ask(group, e0=8.1)
        assert not group.collect_async()[0].restarted.any()
        for _ in range(2):  # To the other host, and back.
            group.reset()
            group.step(rl.BatchedData(["e-0"], [rl.PolicyResponse("e-0", 1.0)]))
        assert group.metrics()["envs/recycled"] == 2
        with takes(world, 8.0, 10.5):
            ask(group, e0=FOR_EVER)
            batch, _ = group.collect_async()
        assert cause(batch) == ["hung in a step and was killed"]


def test_without_a_limit_a_request_may_take_any_time(world: World) -> None:
    """So may a call, and a reset if only steps have a limit."""
    with built(entry()) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=[1e5]))
        assert not batch.restarted.any()
    with built(entry(step_timeout=5.0)) as group:
        batch, _ = group.reset(options={"takes": 1e5})
        assert not batch.restarted.any()


@pytest.mark.parametrize(
    ("seconds", "end"), [([9] * 4, ""), ([0, 99, 0, 0], "hung in a step and was killed")]
)
def test_an_actor_has_the_time_limits_of_all_its_steps(
    world: World, seconds: list[int], end: str
) -> None:
    """It executes them in turn, and doesn't tell which of them takes so long."""
    with built(entry(4, placement="ray", envs_per_process=4, step_timeout=10.0)) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=seconds))
        assert cause(batch) == [end] * 4


def test_a_worker_that_survives_its_kill_ends_with_its_fork_server(world: World) -> None:
    """Some seconds after the kill."""
    with built(entry(step_timeout=5.0)) as group:
        group.reset()
        stop_server_of(group._core.supervisor.hosts[0])
        with takes(world, 5.0 + times.OBEY, 5.0 + times.OBEY + 1.0):
            ask(group, e0=FOR_EVER)
            batch, _ = group.collect_async()
        assert cause(batch) == ["hung in a step and was killed"]
        assert world.counts["fork servers killed"] == 1


def test_a_fork_server_has_its_time_to_kill_though_the_trainer_was_stopped(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both were, when the order was given."""
    with built(entry(step_timeout=5.0)) as group:
        group.reset()
        stopped_in(world, monkeypatch, "kill", partial(stop_server_of, seconds=60.1))
        ask(group, e0=FOR_EVER)
        assert group.collect_async()[0].restarted.all()
        monkeypatch.undo()
    assert world.counts["fork servers killed"] == 0
    assert world.wrongs == []


@pytest.mark.parametrize("world", [SEED, 18], indirect=True)
@pytest.mark.parametrize("num_workers", [1, 2, 3])
@pytest.mark.parametrize("look", range(1, 9))
def test_deaths_that_are_read_late_cost_no_fork_server(
    world: World, num_workers: int, look: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At whichever look at the clock after the kill the trainer is stopped for a minute.

    In both worlds a socket to a fork server has room for two messages, so some wait meanwhile.
    """
    looks, clock, kill = [0], time.monotonic, ProcessHost.kill

    def late() -> float:
        if world.running is None:  # It is the trainer who looks.
            looks[0] += looks[0] > 0
            if looks[0] == look + 1:
                world.sleep(60.0)
        return clock()

    def killed(host: Any, **how: Any) -> None:
        kill(host, **how)
        looks[0] = 1

    monkeypatch.setattr(time, "monotonic", late)
    monkeypatch.setattr(ProcessHost, "kill", killed)
    with built(entry(num_workers, step_timeout=5.0)) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=np.full(num_workers, FOR_EVER)))
        assert batch.restarted.all()
        monkeypatch.undo()
    assert world.counts["fork servers killed"] == 0


# -- aborts


def test_an_aborted_request_that_exceeds_its_limit_is_no_hang(world: World) -> None:
    """Its worker is replaced as after any abort, and only once."""
    with built(entry(step_timeout=0.1, on_worker_death="raise")) as group:
        group.reset()
        ask(group, e0=FOR_EVER)
        world.sleep(0.01)
        group.abort()
        ask(group, e0=0.0)
        batch, _ = group.collect_async()
        assert cause(batch) == ["was aborted"]
        assert group.get_workers()[0]["restarts"] == 1


@pytest.mark.parametrize("second", ["e0", "e1"])
def test_each_aborted_request_has_its_time_to_end(world: World, second: str) -> None:
    """Whatever was aborted just before, of the same env or of another of its worker."""
    with built(entry(2, envs_per_process=2)) as group:
        group.reset()
        ask(group, e0=0.12)
        group.abort()
        world.sleep(0.02)
        ask(group, **{second: 0.12})
        group.abort()
        assert group.get_workers()[0]["restarts"] == 0


# -- starts


def builds_in(seconds: float) -> Any:
    def make() -> Timed:
        time.sleep(seconds)
        return Timed()

    return make


def test_workers_start_at_the_same_time(world: World) -> None:
    with takes(world, 9.0, 10.0), built(entry(5, task=builds_in(9.0))) as group:
        assert len(group.init()) == 5


@pytest.mark.parametrize("is_stopped", [False, True])
def test_a_late_start_is_given_up(
    world: World, is_stopped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After some time to write its stacks, whether or not it can be killed."""
    if is_stopped:
        kill = ProcessHost.kill

        def stopped(host: Any, **how: Any) -> None:
            stop_server_of(host)
            kill(host, **how)

        monkeypatch.setattr(ProcessHost, "kill", stopped)
    config = entry(2, task=[Timed, builds_in(FOR_EVER)], start_timeout=10.0)
    group = built(config)
    with (
        takes(world, 10.0, 25.0),  # A part of its order may have come late.
        pytest.raises(StartFailed, match=r"env 'e-1' .* did not start within 10.0 s"),
    ):
        group.init()


@pytest.mark.parametrize("order", ["start", "attach"])
def test_a_start_has_its_time_though_the_trainer_was_stopped(
    world: World, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When it gave an order; that of a replacement as well."""
    with built(entry(task=builds_in(8.0), start_timeout=10.0)) as group:
        stopped_in(world, monkeypatch, order)
        batch, _ = group.reset()
        world.kill([group.get_workers()[0]["pid"]])
        batch, _ = group.step(batch.respond(action=[0.0]))
        assert cause(batch)[0].startswith("was killed by SIGKILL")
        assert world.deaths["worker 0"] == 1
        monkeypatch.undo()
    assert world.wrongs == []


def sized(content: bytes) -> Timed:
    return Timed()


def test_what_was_not_sent_is_dropped_with_its_worker(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A replacement dies before it has its whole order, and a look for late ones reads of that."""

    def kill(host: Any) -> None:
        monkeypatch.undo()  # The next one lives.
        world.sleep(1.0)
        world.kill([process.pid for process in world._processes])
        world.sleep(1.0)
        assert host.catch_up()

    with built(entry(task=partial(sized, bytes(100_000)), start_timeout=10.0)) as group:
        batch, _ = group.reset()
        stopped_in(world, monkeypatch, "start", kill)
        world.kill([group.get_workers()[0]["pid"]])
        batch, _ = group.step(batch.respond(action=[0.0]))
        assert batch.restarted.all()
        assert world.deaths["worker 0"] == 2


def test_the_time_of_a_start_counts_from_the_death(world: World) -> None:
    """Not from the last time that the supervisor ran; and it may be up before it runs again."""
    with built(entry(task=builds_in(8.0), start_timeout=10.0)) as group:
        batch, _ = group.reset()
        world.sleep(1000.0)
        world.kill([group.get_workers()[0]["pid"]])
        ask(group, e0=0.0)
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=1.0)
        world.sleep(60.0)
        batch, _ = group.collect_async()
        assert batch.restarted.all()
        assert world.deaths["worker 0"] == 1


made: list[int] = []


class Growing(Timed):
    """Those that are made later have another space."""

    def __init__(self) -> None:
        made.append(1)
        self.size = len(made)
        self.observation_space = gym.spaces.Box(-9, 9, (self.size,), np.float64)

    def observed(self) -> Any:
        return np.zeros(self.size)


def test_a_replacement_with_other_spaces_is_refused(world: World) -> None:
    """Its results would not fit the rows."""
    made.clear()
    with built(entry(task=Growing, max_restarts=1)) as group:
        batch, _ = group.reset()
        world.kill([group.get_workers()[0]["pid"]])
        with pytest.raises(WorkerDied, match="its spaces changed with the restart"):
            group.step(batch.respond(action=[0.0]))


def test_closing_does_not_wait_for_a_restart(world: World) -> None:
    """A worker that is down has nothing to close, and is not started again."""
    with built(entry(task=builds_in(0.5), max_restarts=99)) as group:
        group.reset()
        for _ in range(5):
            world.kill([group.get_workers()[0]["pid"]])
            group.reset()
        world.kill([group.get_workers()[0]["pid"]])
        ask(group, e0=0.0)
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=0.01)
        with takes(world, 0.0, 0.5):
            group.close()


# -- collecting


def test_a_window_ends_for_results_that_joined_before_the_minimum(world: World) -> None:
    """After the window, a collect returns once it has the minimum."""
    with built(entry(8)) as group:
        group.reset()
        ask(group, e0=1.0, e1=1.5, e2=1.5, **{f"e{k}": 99.0 for k in range(3, 8)})
        with takes(world, 1.9, 2.5):
            batch, _ = group.collect_async(timeout=1.0, min_results=3)
        assert batch.ids() == ["e-0", "e-1", "e-2"]
        with takes(world, 96.5, 98.0):
            assert len(group.collect_async(timeout=1.0)[0]) == 5


@pytest.mark.parametrize("rules", [{"deadline": 1.5}, {"timeout": 1.5}])
def test_inline_envs_are_not_executed_past_a_deadline_or_a_window(
    world: World, rules: dict[str, Any]
) -> None:
    """The wait ends after the current env; the window opens when the first result is there."""
    with built(entry(5, placement="inline")) as group:
        batch, _ = group.reset()
        group.step_async(batch.respond(action=np.ones(5)))
        if "deadline" in rules:
            with takes(world, 2.0, 2.5), pytest.raises(TimeoutError, match="2 of the 5"):
                group.collect_async(min_results=5, **rules)
        else:
            with takes(world, 3.0, 3.5):
                assert group.collect_async(**rules)[0].ids() == ["e-0", "e-1", "e-2"]
        with takes(world, 2.0, 3.5):
            group.collect_async(wait_all=True)


# -- what comes in an odd order


def test_a_loss_that_is_read_before_the_last_answer_comes_after_it(world: World) -> None:
    """Answers travel in a ring, and losses in frames."""
    why = Loss("ended while it was idle", "env_died", "env", "e-0")
    with built(entry()) as group:
        group.reset()
        core = group._core
        for is_lost in (False, True):
            ask(group, e0=0.0)
            world.sleep(1.0)  # The answer is there, and unread.
            answered = core.requests.numbering.entry.item(0)
            core.tables.completions.append(Lost(0, 0, why, answered=answered))
            batch, _ = group.collect_async()
            assert batch.restarted.tolist() == batch.is_reset.tolist() == [is_lost]
            assert core.episodes.why_lost(0) == why
            assert core.supervisor.records[0].restarts == is_lost + 1


@pytest.mark.parametrize("ordinary", [True, False])
@pytest.mark.parametrize("what", ["step", "step_async", "reset", "snapshot"])
def test_requests_that_were_sent_in_part_disturb_no_other_call(
    world: World, what: str, ordinary: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their results are left to the collector; the value of a call is dropped."""
    ids = ["e-0", "e-1"]
    with built(entry(3)) as group:
        group.reset()
        core = group._core
        core.tables.conditions.note(UNLIKE_ENVS, not ordinary)
        values = [rl.PolicyResponse(env_id, 0.0) for env_id in ids]
        both = rl.BatchedData(ids, values)
        asked: dict[str, Callable[[], Any]] = {
            "step": lambda: group.step(both),
            "step_async": lambda: group.step_async(both),
            "reset": lambda: group.reset(env_ids=ids),
            "snapshot": lambda: group.snapshot(ids),
        }
        world.sleep(1.0)  # All workers sleep.
        broken, ring = Mock(side_effect=OSError("no buffer space")), core.requests.rings[1]
        assert ring is not None
        core.requests.rings[1] = ring._replace(wake=broken)
        with monkeypatch.context() as patch:
            patch.setattr(core.supervisor.hosts[1], "submit", broken)
            with pytest.raises(OSError, match="no buffer space"):
                asked[what]()
        core.requests.rings[1] = ring
        ask(group, e2=0.0)
        world.sleep(1.0)
        left = ["e-2"] if what == "snapshot" else ["e-0", "e-2"]
        assert group.collect_async(min_results=len(left))[0].ids() == left


def test_calls_go_on_when_one_is_cancelled(world: World) -> None:
    """Whichever waits for the first result; what it asked for is collected."""

    async def main(whose: int) -> None:
        async with rl.build_env_group(entry(4)) as group:
            batch, _ = await group.reset()
            steps = [
                asyncio.ensure_future(group.step(batch.take([k]).respond(action=[1.0 + k])))
                for k in range(4)
            ]
            await asyncio.sleep(0.5)
            steps[whose].cancel()
            await asyncio.wait(steps)
            others = [step for step in steps if not step.cancelled()]
            assert [step.result()[0].ids() for step in others] == [
                [f"e-{k}"] for k in range(4) if k != whose
            ]
            assert (await group.collect_async())[0].ids() == [f"e-{whose}"]

    for whose in (0, 3):
        world.run(main(whose))


def test_a_program_that_goes_on_without_end_fails(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing happens in its world: its event loop turns."""
    monkeypatch.setattr("simulator.world._MAX_EVENTS", 1000)

    def turn() -> None:
        asyncio.get_running_loop().call_soon(turn)

    async def main() -> None:
        turn()
        await asyncio.Event().wait()

    with pytest.raises(Deadlock):
        world.run(main())
