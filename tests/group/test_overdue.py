"""An env that owes a result for a minute, and that nothing ends, is named in the log."""

from __future__ import annotations

import math
import re
import threading
import time
from typing import Any

import pytest
from kit.scripted import Counts
from patience import HANG

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio._core.group.supervision import workers


class Stuck(Counts):
    """Waits in a step with action 1 until a file is there."""

    def __init__(self, gate: Any) -> None:
        self._gate = gate

    def step(self, action: Any) -> Any:
        if action == 1:
            self.wait()
        return super().step(0)

    def wait(self) -> None:
        while not self._gate.exists():
            threading.Event().wait(0.05)


@pytest.fixture
def gate(tmp_path: Any) -> Any:
    """Return a path; envs that are stuck go on once the file is there."""
    return tmp_path / "gate"


def watch(group: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a group whose envs have been reset wait no more than a moment."""
    monkeypatch.setattr(workers, "OWED_SECONDS", 0.3)
    supervisor = group._core.supervisor
    supervisor.overdue.begin(time.monotonic())
    supervisor.plan()
    if isinstance(group, rl.EnvGroup):
        group._driver._end_nudge()  # It has a timer for a minute, if a reset has waited.


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
    """A warning says env, seconds and setting."""
    (record,) = said(caplog)
    assert record.levelname == "WARNING"
    assert record.getMessage().startswith("env 'env-1' (entry 'env'")
    assert re.search(r"has owed a result for \d+ s", record.getMessage())
    assert "set step_timeout of its entry" in record.getMessage()


def entry(gate: Any, **fields: Any) -> dict[str, Any]:
    return {"name": "env", "task": lambda: Stuck(gate), "num_workers": 3, **fields}


@pytest.mark.parametrize("fields", [{}, {"reset_timeout": HANG}], ids=["no limit", "of resets"])
def test_a_call_that_waits_says_for_whom(
    gate: Any, fields: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, in a synchronous group."""
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
        while not said(caplog):
            with pytest.raises(TimeoutError):
                await group.collect_async(wait_all=True, deadline=1)
        gate.touch()
        await group.collect_async(wait_all=True)
    check(caplog)


def test_a_method_is_named_and_a_place_without_a_client_is_not(
    gate: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit of steps ends no method, and one would not bring a client."""
    arm = {"name": "arm", "backend": "env_server", "env_kwargs": {"connect_timeout": math.inf}}
    with sync.build_env_group([entry(gate, step_timeout=HANG), arm]) as group:
        group.reset_async()
        group.collect_async(min_results=3)
        watch(group, monkeypatch)
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=1)
        thread = opened_by_warning(gate, caplog)
        group.call("wait", env_ids=["env-1"])
        thread.join()
    (record,) = said(caplog)
    assert record.getMessage().startswith("env 'env-1' (entry 'env'")
    assert "nothing ends what it does but abort()" in record.getMessage()


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
        supervisor = group._core.supervisor
        supervisor.overdue.due = supervisor.due = 0.0  # It looks at each wait.
        for _ in range(10):
            batch, _ = group.step(batch.respond([0, 0, 0]))
    assert said(caplog) == []
