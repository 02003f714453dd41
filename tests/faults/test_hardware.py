"""Hardware stops: when an action or a result is refused, when a call is interrupted, at the end."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from threading import Event, Semaphore
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from kit.counting import ClientThread
from kit.scripted import Counts
from patience import HANG

from rlightning_aio import (
    ENVS,
    BaseEnv,
    BatchedData,
    EnvConfig,
    EnvRet,
    PolicyResponse,
    build_env_group,
    sync,
)
from rlightning_aio._core.hosts.running.build_env import build_env
from rlightning_aio.attempts import EpisodeSpec, play
from rlightning_aio.envs import hardware
from rlightning_aio.envs.hardware import watched
from rlightning_aio.errors import (
    BadAction,
    ConfigError,
    EnvHung,
    EnvRaised,
    EpisodeLost,
    RLightningError,
)
from rlightning_aio.evaluation import evaluate
from rlightning_aio.protocol.entries import RENEW

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PLACEMENTS = ("process", "inline")
SPACE = gym.spaces.Dict({"joints": gym.spaces.Box(-1, 1, (2,), np.float32)})


class Arm(BaseEnv):
    """Writes what happens to it to a log, and returns what its entry says.

    A reset with ``options={"slow": True}`` lasts until the arm is stopped.
    """

    def __init__(self, config: EnvConfig, worker_index: int = 0, preprocess_fn: Any = None) -> None:
        super().__init__(config, worker_index, preprocess_fn)
        self.kwargs = config.env_kwargs
        self.log = Path(config.env_kwargs["log"])
        self.is_stopped, self.stopping = threading.Event(), threading.Lock()

    def note(self, what: str) -> None:
        with self.log.open("a") as file:
            file.write(f"{what}\n")

    def get_observation_space(self) -> gym.Space[Any]:
        return SPACE

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1, 1, (2,), np.float32)

    def _ret(self, observation: Any) -> EnvRet:
        if observation is OSError:
            raise OSError("the cable broke")
        return EnvRet(env_id=self.env_id, observation=observation)

    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        self.is_stopped.clear()
        self.note("reset")
        if options:
            self.is_stopped.wait(HANG)
            raise RuntimeError("stopped on its way")
        return self._ret(self.kwargs.get("first", {"joints": np.zeros(2, np.float32)}))

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        with self.stopping:  # A stop that is in the log has been carried out.
            if self.is_stopped.is_set():
                raise RuntimeError("stopped; reset() starts it again")
        self.note(f"step {np.asarray(policy_resp.action).tolist()}")
        return self._ret(self.kwargs.get("result", {"joints": np.ones(2, np.float32)}))

    def stop(self) -> None:
        with self.stopping:
            if not self.is_stopped.is_set():
                self.note("stop")
                self.is_stopped.set()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def arm(log: Path) -> Iterator[Callable[..., dict[str, Any]]]:
    """Make an entry of one arm."""
    ENVS.register("test arm", hardware=True)(Arm)

    def entry(placement: str, **env_kwargs: Any) -> dict[str, Any]:
        kwargs = {"log": str(log), **env_kwargs}
        place = {"placement": placement, "env_kwargs": kwargs}
        return {"name": "arm", "backend": "test arm", "task": "any", **place}

    yield entry
    for thread in threading.enumerate():
        if thread.name == "stops hardware":  # It may still write to the log.
            thread.join(HANG)
    del ENVS._classes["test arm"]  # noqa: SLF001
    ENVS._hardware.pop("test arm", None)  # noqa: SLF001


def lines(log: Path) -> list[str]:
    return log.read_text().splitlines() if log.exists() else []


def wait_for(log: Path, line: str) -> None:
    until = time.monotonic() + HANG
    while line not in lines(log):
        assert time.monotonic() < until, lines(log)
        time.sleep(0.01)


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize(
    ("action", "words"),
    [([1e30, 0], r"holds 1\.0+[0-9]*e.30"), ([0, 1.001], "holds 1.001"), ([-2, 0], "holds -2")],
)
def test_an_action_beyond_the_bounds_never_reaches_an_arm(
    arm: Any, log: Path, placement: str, action: list[float], words: str
) -> None:
    """The arm is stopped instead; what fits after the cast to float32 passes."""
    with sync.build_env_group(arm(placement)) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=np.array([[1 + 1e-9, -1]])))
        with pytest.raises(BadAction, match=words):
            group.step(batch.respond(action=np.array([action])))
        wait_for(log, "stop")
    assert lines(log) == ["reset", "step [1.0, -1.0]", "stop"]


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_what_a_preprocess_function_makes_is_looked_at(arm: Any, log: Path, placement: str) -> None:
    """What it gets may be anything."""

    def scaled(policy_resp: PolicyResponse) -> Any:
        return np.array(policy_resp.action["percent"]) / 100

    class Preprocessed(Arm):
        def step(self, policy_resp: PolicyResponse) -> EnvRet:
            action = self._preprocess_fn(policy_resp)
            return super().step(PolicyResponse(self.env_id, action))

    ENVS.register("test arm", hardware=True)(Preprocessed)
    with sync.build_env_group(arm(placement), preprocess_fn=scaled) as group:
        group.reset()
        group.step(BatchedData(["arm-0"], [PolicyResponse("arm-0", {"percent": [50, 100]})]))
        with pytest.raises(BadAction, match=r"holds 1\.5"):
            group.step(BatchedData(["arm-0"], [PolicyResponse("arm-0", {"percent": [150, 0]})]))
        wait_for(log, "stop")
    assert lines(log) == ["reset", "step [0.5, 1.0]", "stop"]


@contextlib.contextmanager
def driven(entry: dict[str, Any]) -> Iterator[Any]:
    """A group of the arm of an entry, or of a client that has it, which is no placement."""
    if entry["placement"] != "client":
        with sync.build_env_group(entry) as group:
            yield group
        return
    config, is_over = EnvConfig(**entry | {"placement": "inline"}), Event()
    env = build_env(config, is_hardware=True)  # As the command `client` does.
    env.on_disconnect, env.is_finish = is_over.set, is_over.is_set
    with sync.build_env_group(name="arm", backend="env_server") as group:
        client = ClientThread(group["arm-0"].address, "c", env)
        yield group
    client.join()


@pytest.mark.parametrize("placement", [*PLACEMENTS, "client"])
@pytest.mark.parametrize("call", ["reset", "step"])
@pytest.mark.parametrize(
    "result",
    [OSError, None, {}, {"joints": None}, {"joints": [1.0, 2.0, 3.0]}, {"joints": "two"}],
)
def test_an_arm_that_raises_or_whose_result_is_refused_stops(
    arm: Any, log: Path, placement: str, call: str, result: Any
) -> None:
    """A missing picture, say, is an error of the env that it does not raise itself."""
    with driven(arm(placement, **{"first" if call == "reset" else "result": result})) as group:
        if call == "reset":
            with pytest.raises(EnvRaised):
                group.reset()
        else:
            batch, _ = group.reset()
            with pytest.raises(EnvRaised):
                group.step(batch.respond(action=np.zeros((1, 2))))
        wait_for(log, "stop")


def of(*actions: Any) -> BatchedData[Any]:
    return BatchedData(["arm-0"] * len(actions), [PolicyResponse("arm-0", a) for a in actions])


REFUSED: dict[str, Callable[[BatchedData[Any]], BatchedData[Any]]] = {
    "None": lambda _: of(None),
    "shape": lambda _: of(np.zeros(3)),
    "kind": lambda _: of("fast"),
    "NaN": lambda _: of([np.nan, 0.0]),
    "two rows": lambda _: of(np.zeros(2), np.zeros(2)),
    "no response": lambda _: BatchedData(["arm-0"], [None]),
    "unknown": lambda _: BatchedData(
        ["arm-0", "arm-7"], [PolicyResponse(i, np.zeros(2)) for i in ("arm-0", "arm-7")]
    ),
    "no column": lambda batch: batch.respond(action=None),
    "a column without rows": lambda batch: batch.respond(action=np.zeros((0, 2))),
    "a row too many": lambda batch: batch.respond(action=np.zeros((2, 2))),
}


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("name", REFUSED)
def test_an_arm_stops_when_the_group_refuses_its_batch(
    arm: Any, log: Path, placement: str, name: str
) -> None:
    """Although nothing was sent."""
    with sync.build_env_group(arm(placement)) as group:
        batch, _ = group.reset()
        with pytest.raises((RLightningError, ValueError)):
            group.step(REFUSED[name](batch))
        wait_for(log, "stop")
        with pytest.raises(EnvRaised, match="stopped"):
            group.step(of(np.zeros(2)))
        group.reset()
    assert lines(log).count("reset") == 2


@pytest.mark.parametrize("wrong", [np.zeros(3), PolicyResponse("right-0", np.zeros(2))])
async def test_only_the_arm_stops_whose_own_action_is_refused(
    arm: Any, tmp_path: Path, wrong: Any
) -> None:
    """Though the steps of both arms, which are asked for one by one, are sent together."""
    logs = [tmp_path / name for name in ("left", "right")]
    entries = [arm("inline", log=str(own)) | {"name": own.name} for own in logs]
    async with build_env_group(entries) as group:
        await group.reset()
        steps = group["left-0"].step(wrong), group["right-0"].step(np.zeros(2))
        found = await asyncio.gather(*steps, return_exceptions=True)
        assert list(map(type, found)) == [BadAction, EnvRet]
        wait_for(logs[0], "stop")
        assert "stop" not in lines(logs[1])


class Coroutines:
    """Makes coroutine functions of the methods of an arm, but for those that end its motion."""

    async def reset(self, **arguments: Any) -> Any:
        return super().reset(**arguments)  # type: ignore[misc]

    async def step(self, action: Any) -> Any:
        return super().step(action)  # type: ignore[misc]


class AwaitableArm(Coroutines, Arm):  # type: ignore[misc]
    pass


class Hanging(AwaitableArm):
    """Never ends a step with a positive action."""

    async def step(self, policy_resp: PolicyResponse) -> EnvRet:  # type: ignore[override]
        if policy_resp.action[0] > 0:
            await asyncio.sleep(HANG)
        return await super().step(policy_resp)


@pytest.mark.parametrize("placement", ["process", "loop"])
async def test_the_arm_stops_that_took_the_place_of_another(
    arm: Any, log: Path, placement: str
) -> None:
    ENVS.register("test arm", hardware=True)(Hanging)
    fields = {**arm(placement), "on_worker_death": "restart", "step_timeout": 0.2}
    async with build_env_group(fields) as group:
        batch, _ = await group.reset()
        with pytest.raises(EnvHung):
            await group.step(batch.respond(action=np.ones((1, 2))))
        wait_for(log, "stop")
        with pytest.raises(EpisodeLost):
            await group.step(batch.respond(action=np.zeros((1, 2))))
        await group.reset()
        assert lines(log) == ["reset", "stop", "reset"]
        log.unlink()  # noqa: ASYNC240
        with pytest.raises(BadAction):
            await group.step(of([np.nan, 0.0]))
        wait_for(log, "stop")


@pytest.mark.parametrize("placement", ["process", "loop"])
async def test_an_awaitable_arm_is_not_rebuilt_for_a_task(
    arm: Any, log: Path, placement: str
) -> None:
    """Nor closed for that, so that it can be told to stop."""
    ENVS.register("test arm", hardware=True)(AwaitableArm)
    async with build_env_group(arm(placement)) as group:
        batch, _ = await group.reset()
        await group["arm-0"].call(RENEW)
        await group.step(batch.respond(action=np.zeros((1, 2))))
        with pytest.raises(BadAction):
            await group.step(of([np.nan, 0.0]))
        wait_for(log, "stop")
    assert lines(log) == ["reset", "step [0.0, 0.0]", "stop"]


class Closing(Arm):
    """Notes every stop, and when it is closed and freed; the second of two closes slowly."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.itself = self  # So that only a collection frees it.

    def stop(self) -> None:
        self.note(f"{self.worker_index} stopped")

    def close(self) -> None:
        self.note(f"{self.worker_index} closed")
        if self.worker_index:
            time.sleep(0.3)

    def __del__(self) -> None:
        self.note(f"{self.worker_index} freed")


def test_an_arm_that_has_closed_is_not_stopped_any_more(log: Path) -> None:
    """Its connection is gone then, while another arm of the dead trainer closes."""
    with running("process", log, "two") as trainer:
        trainer.communicate(timeout=HANG)
    wait_for(log, "1 freed")
    after = lines(log)[lines(log).index("0 closed") :]
    assert "0 stopped" not in after
    assert "1 stopped" not in after[after.index("0 freed") :]


def test_an_arm_is_freed_when_its_group_closes(arm: Any, log: Path) -> None:
    """Nothing keeps it, so that its own end runs."""
    ENVS.register("test arm", hardware=True)(Closing)
    with sync.build_env_group(arm("process")) as group:
        group.reset()
    wait_for(log, "0 freed")


def test_an_actor_of_ray_gets_no_arm(arm: Any) -> None:
    with pytest.raises(ConfigError, match=r"placement: an actor of Ray can't be told to stop"):
        sync.build_env_group(arm("ray"))


TRAINER = """
import sys
from faults.test_hardware import Arm, Closing
from rlightning_aio import ENVS, sync
import rlightning_aio as rl
placement, log, kind = sys.argv[1:]
ENVS.register("test arm", hardware=True)(Closing if kind == "two" else Arm)
entry = {"name": "arm", "backend": "test arm", "task": "any", "placement": placement}
entry["env_kwargs"] = {"log": log}
if kind == "two":
    import os, signal
    entry |= {"num_workers": 2, "envs_per_process": 2}
    with sync.build_env_group(entry) as group:
        group.reset()
        os.kill(os.getpid(), signal.SIGKILL)
if kind == "left":
    group = sync.build_env_group(entry)
    group.init()
    group.reset()
    raise SystemExit
if kind == "sync":
    with sync.build_env_group(entry) as group:
        group.reset(options={"slow": True})
else:
    async def main():
        async with rl.build_env_group(entry) as group:
            await group.reset(options={"slow": True})
    rl.run(main())
"""


def running(placement: str, log: Path, kind: str) -> subprocess.Popen[str]:
    """Start a trainer in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", TRAINER, placement, str(log), kind]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("kind", ["sync", "async"])
@pytest.mark.parametrize(
    ("placement", "number"),
    [
        ("process", signal.SIGINT),
        ("inline", signal.SIGINT),
        ("process", signal.SIGTERM),
        ("process", signal.SIGKILL),
        ("process", signal.SIGSTOP),
    ],
)
def test_an_arm_on_its_way_to_the_reset_position_stops(
    log: Path, kind: str, placement: str, number: int
) -> None:
    """Whoever asked for the reset is interrupted or killed; nobody else could stop the arm. After a
    kill, a line on stderr says to whoever stands beside the arm why it stands still.
    """
    with running(placement, log, kind) as trainer:
        wait_for(log, "reset")
        trainer.send_signal(number)
        wait_for(log, "stop")
        trainer.send_signal(signal.SIGCONT)
        _, said = trainer.communicate(timeout=HANG)
    if number == signal.SIGKILL:
        assert said.count("env 'arm-0' was stopped, as the trainer has ended") == 1, said
        assert lines(log) == ["reset", "stop"]


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_an_arm_stops_when_a_program_ends_that_has_not_closed_its_group(
    log: Path, placement: str
) -> None:
    """As after an error."""
    with running(placement, log, "left") as trainer:
        trainer.communicate(timeout=HANG)
    assert lines(log) == ["reset", "stop"]


class GymnasiumArm(Counts):
    """One that no backend knows."""

    hardware = True
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, log: Path) -> None:
        self.log = log

    def observed(self) -> Any:
        return np.zeros(1, np.float32)

    def stop(self) -> None:
        with self.log.open("a") as file:
            file.write("stop\n")

    def close(self) -> None:
        with self.log.open("a") as file:
            file.write("close\n")


class CoroutineArm(Coroutines, GymnasiumArm):  # type: ignore[misc]
    pass


class StoppedByCoroutine(CoroutineArm):
    async def stop(self) -> None:  # type: ignore[override]
        super().stop()


@pytest.mark.parametrize(
    ("kind", "placement"),
    [(GymnasiumArm, "process"), (GymnasiumArm, "inline"), (CoroutineArm, "process"),
     (CoroutineArm, "loop")],
)  # fmt: skip
async def test_an_arm_of_a_callable_is_hardware(log: Path, kind: Any, placement: str) -> None:
    """It is what its class says, without a backend of its own."""
    entry = {"name": "arm", "task": partial(kind, log), "placement": placement}
    async with build_env_group(entry) as group:
        batch, _ = await group.reset()
        with pytest.raises(BadAction, match=r"holds 1\.5"):
            await group.step(batch.respond(action=np.full((1, 1), 1.5)))
        before = lines(log)
    assert set(before) == {"stop"}
    assert lines(log)[len(before) :][-2:] == ["stop", "close"]
    with pytest.raises(ConfigError, match="restart would move"):
        sync.build_env_group({**entry, "on_env_error": "restart"})


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_an_arm_that_is_not_announced_as_one_is_refused(log: Path, placement: str) -> None:
    """The group would not stop it."""
    entry = {"name": "arm", "task": lambda: GymnasiumArm(log), "placement": placement}
    with pytest.raises(RLightningError, match="on the callable, too"):
        sync.build_env_group(entry).init()


def test_an_arm_that_would_be_stopped_by_a_coroutine_is_refused(log: Path) -> None:
    """Nobody would await it."""
    with pytest.raises(ConfigError, match=r"stop\(\).*make it a plain method"):
        sync.build_env_group(partial(StoppedByCoroutine, log), name="arm").init()


@pytest.mark.parametrize(("kind", "placement"), [(GymnasiumArm, "inline"), (CoroutineArm, "loop")])
def test_an_arm_stops_whose_group_is_never_closed(log: Path, kind: Any, placement: str) -> None:
    """As at the end of a program that raises."""

    async def dropped() -> list[str]:
        group = build_env_group(partial(kind, log), name="arm", placement=placement)
        await group.init()
        await group.reset()
        del group
        gc.collect()
        return lines(log)

    with pytest.warns(ResourceWarning, match="not closed"):
        assert asyncio.run(dropped()) == ["stop"]


@pytest.mark.parametrize("end", ["abort", "close"])
def test_a_reset_that_is_ended_stops_the_arm(arm: Any, log: Path, end: str) -> None:
    """Before its worker is killed."""
    with sync.build_env_group(arm("process")) as group:
        group.reset_async(options={"slow": True})
        wait_for(log, "reset")
        getattr(group, end)()
        assert "stop" in lines(log)


async def test_an_evaluation_that_ends_early_stops_the_arm_before_it_waits_for_it(
    arm: Any, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rlightning_aio.evaluation.playing._PATIENCE_SECONDS", HANG)
    async with build_env_group(arm("process")) as group:
        slow = EpisodeSpec("", 0, {"slow": True})
        evaluating = asyncio.ensure_future(evaluate(group, None, [slow]))
        await asyncio.to_thread(wait_for, log, "reset")
        evaluating.cancel()
        await asyncio.to_thread(wait_for, log, "stop")
        with pytest.raises(asyncio.CancelledError):
            await evaluating


async def test_play_that_ends_early_stops_the_arm_before_its_agent_ends(
    arm: Any, log: Path
) -> None:
    """Which was cancelled, and may take some time."""

    async def agent(episode: Any) -> None:
        try:
            await asyncio.sleep(HANG)
        finally:
            await asyncio.to_thread(wait_for, log, "stop")

    async with build_env_group(arm("process")) as group:
        playing = asyncio.ensure_future(anext(play(group, [("", 0)], agent, 1)))
        await asyncio.to_thread(wait_for, log, "reset")
        playing.cancel()
        await asyncio.wait({playing})
        wait_for(log, "stop")


@pytest.mark.parametrize("placement", PLACEMENTS)
async def test_an_agent_that_leaves_its_episode_stops_the_arm(
    arm: Any, log: Path, placement: str
) -> None:
    async with build_env_group(arm(placement)) as group:
        with pytest.raises(ZeroDivisionError):
            async with group.episode(group.env_ids[0]):
                raise ZeroDivisionError
        await asyncio.to_thread(wait_for, log, "stop")


class InHalves(Arm):
    """Its step is in two halves."""

    def step_async(self, policy_resp: PolicyResponse) -> None:
        self.result = self.step(policy_resp)

    def collect_async(self, timeout: Any = None) -> EnvRet:  # type: ignore[override]
        return self.result


@pytest.mark.parametrize("kind", [Arm, InHalves])
@pytest.mark.parametrize("placement", [*PLACEMENTS, "client"])
def test_a_program_that_sends_no_action_in_time_stops_the_arm(
    arm: Any, log: Path, placement: str, kind: type[Arm]
) -> None:
    """With action_timeout, for robots that go on moving without one."""
    ENVS.register("test arm", hardware=True)(kind)
    with driven(arm(placement, action_timeout=0.2)) as group:
        batch, _ = group.reset()
        wait_for(log, "stop")
        with pytest.raises(EnvRaised, match=r"no action came for 0\.2 s \(action_timeout\)"):
            group.step(batch.respond(action=np.zeros((1, 2))))
        batch, _ = group.reset()
        group.step(batch.respond(action=np.zeros((1, 2))))
        wait_for(log, "step [0.0, 0.0]")
        before = len(lines(log))
        while len(lines(log)) == before:
            time.sleep(0.01)
    assert lines(log)[:5] == ["reset", "stop", "reset", "step [0.0, 0.0]", "stop"]


def test_a_step_that_comes_as_its_time_ends_does_not_move_the_arm_after_the_stop(
    arm: Any, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing would stop that motion. The time is over when somebody looks at the clock."""
    looks, reset_at = Event(), float("inf")

    def looked_at() -> float:
        now = time.monotonic()
        if threading.current_thread() is not threading.main_thread() and now > reset_at + 0.1:
            looks.set()
            time.sleep(0.05)
        return now

    env = build_env(EnvConfig(**arm("inline", action_timeout=0.1)), is_hardware=True)
    monkeypatch.setattr(hardware, "time", SimpleNamespace(monotonic=looked_at))
    env.reset()
    reset_at = time.monotonic()
    assert looks.wait(HANG)
    with contextlib.closing(env), pytest.raises(RuntimeError, match="no action came"):
        env.step(PolicyResponse("arm-0", np.zeros(2)))


class Slow:
    """Two of them stop only at the same time."""

    def __init__(self, both: threading.Barrier) -> None:
        self.both, self.num_stops = both, 0

    def stop(self) -> None:
        self.both.wait(HANG)
        self.num_stops += 1


def test_envs_stop_at_the_same_time_and_at_least_once() -> None:
    """Each takes some time, and what wants them to stop may be over before anybody looks."""
    both = threading.Barrier(2)
    envs: Any = [Slow(both), Slow(both)]
    watched(lambda: envs)()
    assert envs[0].num_stops == envs[1].num_stops >= 1


@pytest.mark.parametrize("seconds", [0, -1, "1", None, float("inf")])
def test_an_action_timeout_is_a_number_of_seconds(arm: Any, seconds: Any) -> None:
    with (
        pytest.raises(ConfigError, match="action_timeout: should be a number of seconds above 0"),
        sync.build_env_group(arm("inline", action_timeout=seconds)),
    ):
        pass


def test_a_stop_that_hangs_is_not_begun_again() -> None:
    """While it runs; the other envs are stopped again and again."""
    looks, hanging, others = Semaphore(0), list[bool](), list[bool]()
    go_on = Event()

    class Hangs:
        env_id = "a"

        def stop(self) -> None:
            hanging.append(True)
            go_on.wait(HANG)

    class Stops:
        env_id = "b"

        def stop(self) -> None:
            others.append(True)
            looks.release()

    envs: Any = [Hangs(), Stops()]
    end = watched(lambda: envs)
    for _ in range(4):
        assert looks.acquire(timeout=HANG)
    assert len(hanging) == 1
    go_on.set()
    end()
    assert len(others) >= 4
