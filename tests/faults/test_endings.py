"""What a worker's envs leave: nothing if it ends in order, and no process if it is killed."""

from __future__ import annotations

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
from faults.leaving import ABORT, EXIT, HANG, SLEEP, Leaving, Starting
from faults.test_shutdown import processes_of, trainer, watched
from kit.processes import fork_server_pid, stop
from kit.scripted import Awaitable
from patience import HANG as PATIENCE

import rlightning_aio.sync as rl

if TYPE_CHECKING:
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


KILLS = {"crash": ABORT, "exit 0": EXIT, "hang": HANG, "abort": HANG, "destroyed": SLEEP}


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
