"""What a worker's envs leave: nothing if it ends in order, and no process if it is killed."""

from __future__ import annotations

import asyncio
import gc
import os
import select
import signal
import weakref
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import pytest
from faults.closing import closed_in
from faults.leaving import ABORT, HANG, SLEEP, Leaving, Starting
from faults.test_shutdown import processes_of, trainer, watched
from kit.processes import fork_server_pid, stop
from kit.scripted import DIE, RAISE, Awaitable, Scripted
from patience import HANG as PATIENCE

import rlightning_aio
import rlightning_aio.sync as rl

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def entry(task: Any, **fields: Any) -> dict[str, Any]:
    return {"name": "e", "backend": "callable", "task": task, "num_workers": 1, **fields}


@pytest.mark.parametrize("kind", ["plain", "awaitable"])
def test_a_worker_ends_as_python_ends(kind: str, tmp_path: Path) -> None:
    """Envs are dropped, cycles too: files are written, folders removed, daemons ended."""
    make = partial(Leaving, tmp_path)
    task = make if kind == "plain" else partial(Awaitable, make)
    with rl.build_env_group(entry(task, close_timeout=PATIENCE)) as group:
        batch, _ = group.reset()
        started = {int(pid) for pid in batch.info("started")[0]}
        group.step(batch.respond(action=[SLEEP]))
        with watched(started) as ended:
            group.close()
            ended()
    assert [path.name for path in tmp_path.iterdir()] == ["log"]
    assert (tmp_path / "log").read_text() == "what it has to say"


def test_an_inline_env_is_freed_when_its_group_closes() -> None:
    made: list[weakref.ref[Any]] = []

    def make() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1")
        made.append(weakref.ref(env.unwrapped))
        return env

    group = rl.build_env_group(entry(make, placement="inline"))
    group.init()
    batch, _ = group.reset()
    group.step(batch.respond(action=[0]))
    group.close()
    gc.collect()
    assert made[0]() is None


class Noting(Scripted):
    """Writes down whether it takes the place of another."""

    def __init__(self, log: Path) -> None:
        with log.open("a") as file:
            file.write("again " if "RLIGHTNING_AIO_RESTARTS" in os.environ else "new ")


@pytest.mark.parametrize("kind", ["worker", "shared", "inline", "awaitable", "loop"])
def test_a_callable_can_know_that_it_was_called_before(kind: str, tmp_path: Path) -> None:
    """After exceptions and deaths: so a file of the env before is continued, not overwritten."""
    dies = kind in ("worker", "shared", "awaitable")
    fields: dict[str, Any] = {"placement": kind} if not dies else {}
    if kind == "shared":
        fields = {"envs_per_process": 2}

    def made(k: int) -> Any:
        env = Noting(tmp_path / str(k))
        return Awaitable(lambda: env) if kind in ("awaitable", "loop") else env

    tasks = [partial(made, k) for k in range(2)]
    config = entry(tasks, num_workers=2, on_env_error="restart", max_restarts=9, **fields)

    async def play() -> None:
        async with rlightning_aio.build_env_group(config) as group:
            batch, _ = await group.reset()
            for action in (RAISE, DIE, RAISE, RAISE, DIE):
                if action != DIE or dies:
                    await group.step(batch.respond(action=[action, 0]))
                    await group.step(batch.respond(action=[0, 0]))

    asyncio.run(play())
    assert "RLIGHTNING_AIO_RESTARTS" not in os.environ
    assert (tmp_path / "0").read_text() == "new " + "again " * (5 if dies else 3)
    deaths = 2 if kind == "shared" else 0
    assert (tmp_path / "1").read_text() == "new " + "again " * deaths


KILLS = {"crash": ABORT, "hang": HANG, "abort": HANG, "destroyed": SLEEP}


@pytest.mark.parametrize("kill", KILLS)
def test_what_an_env_has_started_is_killed_with_its_worker(kill: str) -> None:
    """Whatever the reason, also what has a session of its own or is nobody's child any more."""
    fields = {"step_timeout": 0.2} if kill == "hang" else {}
    group = rl.build_env_group(entry(Starting, on_worker_death="restart", **fields))
    group.init()
    batch, _ = group.reset()
    started = {int(pid) for pid in batch.info("started")[0]}
    assert len(started) == 3
    with watched(started) as ended:
        group.step_async(batch.respond(action=[KILLS[kill]]))
        if kill == "destroyed":
            stop(fork_server_pid(group))
            with watched(processes_of(cast("Any", group))) as all_ended:
                group.close()
                all_ended()
        elif kill == "abort":
            group.abort()
        else:
            group.collect_async()
        ended()
    group.close()


@pytest.mark.parametrize("kill", ["crash", "abort"])
def test_what_outlives_a_worker_is_not_killed_with_it(kill: str) -> None:
    """An arm's watchdog, say, with what is below it; all else that the env has started is."""
    task = partial(Starting, {"RLIGHTNING_AIO_OUTLIVES": "1"})
    with rl.build_env_group(entry(task, on_worker_death="restart")) as group:
        batch, _ = group.reset()
        below, watchdog, other = (int(pid) for pid in batch.info("started")[0])
        with watched({other}) as ended, watched({watchdog, below}) as left_ended:
            group.step_async(batch.respond(action=[KILLS[kill]]))
            if kill == "abort":
                group.abort()
            else:
                group.collect_async()
            ended()
            watches = [os.pidfd_open(pid) for pid in (watchdog, below)]
            assert not select.select(watches, [], [], 0)[0]
            for watch in watches:
                signal.pidfd_send_signal(watch, signal.SIGTERM)
                os.close(watch)
            left_ended()


SLOW = """
    import asyncio, pathlib
    from faults.closing import IMPORTS
    fields = {"name": "e", "num_workers": 2, "envs_per_process": 2, **IMPORTS}
    kwargs = {"seconds": float(sys.argv[3]), "folder": sys.argv[2]}
    limit = {"close_timeout": float(sys.argv[4])} if sys.argv[4] else {}
    group = rlightning_aio.sync.build_env_group(
        {**fields, "backend": sys.argv[1], "env_kwargs": kwargs, **limit}
    )
    group.init(); group.reset()
    say("ready")
    if sys.argv[5] == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if sys.argv[5] == "forgotten":
        del group
"""


@pytest.mark.parametrize("end", ["killed", "returned", "forgotten"])
@pytest.mark.parametrize(
    ("backend", "seconds", "limit"),
    [
        ("closing", "1", str(PATIENCE)),  # Each of two, one after the other.
        ("closing, awaitable", "2", ""),
    ],
)
def test_close_timeout_holds_when_the_trainer_is_gone(
    backend: str, seconds: str, limit: str, end: str, tmp_path: Path
) -> None:
    """However it ends, its envs have their time to close."""
    with trainer(SLOW, backend, str(tmp_path), seconds, limit, end) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        # The workers have it open, too.
        process.stdout.read()
    assert closed_in(tmp_path) == ["e-0", "e-1"]


def test_an_env_that_does_not_close_in_time_is_killed_when_the_trainer_is_gone(
    tmp_path: Path,
) -> None:
    arguments = ("closing", str(tmp_path), "1e6", "0.1", "killed")
    with trainer(SLOW, *arguments) as process:
        assert process.stdout is not None
        assert process.stdout.read() == "ready\n"
    assert not closed_in(tmp_path)


class Port:
    """An awaitable env that has a port, so to speak, from its making until it has closed."""

    is_open = False
    when_made: Callable[[], object] = staticmethod(lambda: None)

    def __init__(self) -> None:
        self.observation_space: Any = gym.spaces.Discrete(2)
        self.action_space: Any = gym.spaces.Discrete(3)
        Port.when_made()
        if Port.is_open:
            raise OSError("port in use")
        Port.is_open = True

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del seed, options
        return 0, {}

    async def step(self, action: int) -> Any:
        if action == HANG:
            await asyncio.Event().wait()
        return 0, 0.0, False, False, {}

    async def close(self) -> None:
        await asyncio.sleep(1.6)
        Port.is_open = False


async def test_an_env_that_is_aborted_as_it_is_made_closes_before_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    aborting: list[asyncio.Task[None]] = []
    made = asyncio.Event()

    def abort() -> None:
        made.set()
        aborting.append(asyncio.ensure_future(group.abort()))

    async with rlightning_aio.build_env_group(entry(Port, placement="loop")) as group:
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=[HANG]))
        await group.abort()
        with monkeypatch.context() as patch:
            patch.setattr(Port, "when_made", abort)
            group.reset_async()
            await made.wait()
        await asyncio.wait(aborting)
        batch, _ = await group.reset()
        assert batch.is_reset.tolist() == [True]
