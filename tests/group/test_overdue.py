"""Envs that owe a result for a minute, and that nothing ends, are named in the log."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import threading
import time
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import Counts
from patience import HANG

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio._core.group.supervision import overdue


class Stuck(Counts):
    """Waits in a step with action 1 until a file is there."""

    def __init__(self, gate: Any) -> None:
        self._gate = gate

    def step(self, action: Any) -> Any:
        while action == 1 and not self._gate.exists():
            threading.Event().wait(0.2)  # Long, to be found here.
        return super().step(0)


@pytest.fixture
def gate(tmp_path: Any) -> Any:
    """Return a path; envs that are stuck go on once the file is there."""
    return tmp_path / "gate"


def watch(group: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a group whose envs have been reset wait no more than a moment."""
    monkeypatch.setattr(overdue, "OWED_SECONDS", 0.3)
    group._core.supervisor.overdue.begin(time.monotonic())
    if isinstance(group, rl.EnvGroup):
        group._driver._end_nudge()  # It has a timer for a minute, if a reset has waited.


@pytest.fixture(autouse=True)
def everything_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """Also what only somebody who looks for a cause reads."""
    caplog.set_level("DEBUG", "rlightning_aio")


def said(caplog: pytest.LogCaptureFixture) -> list[Any]:
    return [r for r in caplog.records if "has owed a result" in r.getMessage()]


def opened_by_warning(gate: Any, caplog: pytest.LogCaptureFixture) -> threading.Thread:
    """Open the gate once something is said, in a thread."""

    def watch() -> None:
        for _ in range(int(HANG * 100)):
            if said(caplog):
                break
            threading.Event().wait(0.01)
        gate.touch()

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


def check(caplog: pytest.LogCaptureFixture) -> None:
    """A warning says env, seconds, setting and where the env stands; the stacks are at DEBUG."""
    (record,) = said(caplog)
    assert record.levelname == "WARNING"
    assert record.getMessage().startswith("env 'env-1' (entry 'env'")
    assert re.search(r"has owed a result for \d+ s", record.getMessage())
    assert "set step_timeout of its entry" in record.getMessage()
    assert re.search(rf"stands in step, {__file__}:\d+ > wait, .*threading", record.getMessage())
    (stacks,) = [r for r in caplog.records if "the stacks of env-1" in r.getMessage()]
    assert stacks.levelname == "DEBUG"
    assert "most recent call first" in stacks.getMessage()


def entry(gate: Any, **fields: Any) -> dict[str, Any]:
    return {"name": "env", "task": lambda: Stuck(gate), "num_workers": 3, **fields}


@pytest.mark.parametrize("fields", [{}, {"reset_timeout": HANG}], ids=["no limit", "of resets"])
def test_a_call_that_waits_says_for_whom(
    gate: Any, fields: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once for each entry, in a synchronous group."""
    with sync.build_env_group(entry(gate, **fields)) as group:
        batch, _ = group.reset()
        watch(group, monkeypatch)
        thread = opened_by_warning(gate, caplog)
        batch, _ = group.step(batch.respond([0, 1, 1]))
        thread.join()
        assert len(batch) == 3
        gate.unlink()
        threading.Timer(1, gate.touch).start()
        group.step(batch.respond([1, 0, 0]))
    check(caplog)


async def test_an_asynchronous_call_that_waits_says_for_whom(
    gate: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a call with a deadline waits."""
    async with rl.build_env_group(entry(gate)) as group:
        batch, _ = await group.reset()
        watch(group, monkeypatch)
        thread = opened_by_warning(gate, caplog)
        group.step_async(batch.respond([0, 1, 0]))
        await group.collect_async(wait_all=True)
        thread.join()
    check(caplog)
    caplog.clear()
    gate.unlink()
    async with rl.build_env_group(entry(gate)) as group:
        batch, _ = await group.reset()
        watch(group, monkeypatch)
        group.step_async(batch.respond([0, 1, 0]))
        while not said(caplog):  # The worker may be slow to say where it stands.
            with pytest.raises(TimeoutError):
                await group.collect_async(wait_all=True, deadline=1)
        gate.touch()
        await group.collect_async(wait_all=True)
    check(caplog)


def test_nothing_is_said_of_envs_with_a_limit_or_that_reply(
    gate: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor of others, before a minute has passed."""
    with sync.build_env_group(entry(gate, step_timeout=HANG)) as group:
        batch, _ = group.reset()
        watch(group, monkeypatch)
        threading.Timer(1, gate.touch).start()
        batch, _ = group.step(batch.respond([0, 1, 0]))
    with sync.build_env_group(entry(gate)) as group:
        batch, _ = group.reset()
        group._core.supervisor.overdue.due = 0.0  # It looks at each wait.
        for _ in range(10):
            batch, _ = group.step(batch.respond([0, 0, 0]))
    assert said(caplog) == []


class Waiting:
    """Awaits an event in a step with action 1."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, gate: asyncio.Event) -> None:
        self._gate = gate

    async def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(1, np.float32), {}

    async def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action == 1:
            await self._gate.wait()
        return np.zeros(1, np.float32), 1.0, False, False, {}


async def test_an_awaited_env_is_said_to_stand_where_it_awaits(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its own code, on the trainer's event loop."""
    gate = asyncio.Event()
    fields = {"task": lambda: Waiting(gate), "placement": "loop"}
    async with rl.build_env_group(entry(None, **fields)) as group:
        batch, _ = await group.reset()
        watch(group, monkeypatch)
        group.step_async(batch.respond([0, 1, 0]))
        collect = asyncio.create_task(group.collect_async(wait_all=True))
        while not said(caplog):
            await asyncio.wait([collect], timeout=0.01)
        gate.set()
        await collect
    (record,) = said(caplog)
    stands = rf"stands in Waiting\.step, {__file__}:\d+ > Event.wait, .*locks"
    assert re.search(stands, record.getMessage())


async def test_a_group_that_is_closed_is_asked_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """Also if its answer was due later."""
    is_closed, answers = False, list[bool]()
    fields = {"task": lambda: Waiting(asyncio.Event()), "placement": "loop"}
    async with rl.build_env_group(entry(None, **fields)) as group:
        await group.reset()
        (record,) = group._core.supervisor.records
        record.inspect(0, lambda *_: answers.append(is_closed), after=0.05)
    is_closed = True
    await asyncio.sleep(0.1)
    assert True not in answers  # On a busy machine, it may have been asked before.
    assert not [one for one in caplog.records if one.name == "asyncio" and one.exc_info]


def test_a_stopped_worker_says_nothing_and_is_named(
    gate: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It can't write its stacks, and goes on unharmed once it is continued."""
    with sync.build_env_group(entry(gate)) as group:
        batch, _ = group.reset()
        (pid,) = [one["pid"] for one in group.get_workers() if "env-1" in one["env_ids"]]
        os.kill(pid, signal.SIGSTOP)
        watch(group, monkeypatch)

        def go_on() -> None:
            for _ in range(int(HANG * 100)):
                if said(caplog):
                    break
                threading.Event().wait(0.01)
            os.kill(pid, signal.SIGCONT)

        thread = threading.Thread(target=go_on)
        thread.start()
        batch, _ = group.step(batch.respond([0, 0, 0]))
        thread.join()
        assert len(group.step(batch.respond([0, 0, 0]))[0]) == 3
    (record,) = said(caplog)
    assert "stands in" not in record.getMessage()


def test_a_worker_that_dies_before_it_says_where_it_stands_leaves_no_question(gate: Any) -> None:
    """Nobody gets an answer of its replacement, which answers the next question."""
    with sync.build_env_group(entry(gate, num_workers=1)) as group:
        batch, _ = group.reset()
        (record,) = group._core.supervisor.records
        answers: list[str] = []
        record.inspect(0, lambda *_: answers.append("first"), after=HANG)
        os.kill(group.get_workers()[0]["pid"], signal.SIGKILL)
        batch, _ = group.step(batch.respond([0]))
        assert batch.restarted.all()
        record.inspect(0, lambda _, stacks: answers.append(stacks))
        while not answers:
            batch, _ = group.step(batch.respond([0]))
        (stacks,) = answers
        assert "Current thread" in stacks


def test_a_loop_keeps_no_timer_of_a_closed_group(gate: Any) -> None:
    """Nor of one that has nothing left to say."""

    async def main() -> None:
        async with rl.build_env_group(entry(gate)) as group:
            batch, _ = await group.reset()
            await group.step(batch.respond([0, 0, 0]))
            driver = group._driver
        assert driver._nudge is None

    asyncio.run(main())
