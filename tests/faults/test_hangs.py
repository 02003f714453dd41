"""An env that hangs is found, its stack is shown, and it is killed and replaced."""

from __future__ import annotations

import os
import signal
import threading
import time
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from kit.driven import Driven, kinds_on_both_drivers, on_one_driver
from kit.processes import fork_server_pid, pid_of, stop, wait_for_reply
from kit.tokens import Tokens, entry, marked, two_workers
from patience import HANG

import rlightning_aio
from rlightning_aio import registry
from rlightning_aio._core.hosts import times
from rlightning_aio.errors import EnvHung, StartFailed, WorkerDied

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Start: TypeAlias = Callable[..., Driven]

LIMIT = 1.0
"""Seconds; long enough for a worker that doesn't hang, even on a busy machine."""

STACKS = {
    "sleep": "in <lambda>",
    "loop in C": "in <lambda>",
    "deadlock": "in _deadlock",
    "deadlock with the GIL": "in _deadlock_with_the_gil",
}


def any_killed(group: Any) -> bool:
    """Return True if a worker was killed, or will be once it has written its stacks."""
    return any(record.dying or record.restarts for record in group._core.supervisor.records)


@kinds_on_both_drivers("hangs", STACKS)
def test_hung_step_raises_with_the_stack_of_the_worker(start: Start, hangs: list[str]) -> None:
    """Even if the step holds the interpreter's lock and never returns."""
    ends = {"step_timeout": LIMIT, "on_worker_death": "raise"}
    group, tokens = start(entry(1 + len(hangs), envs_per_process=1, **ends)), Tokens()
    alive = list(group.group.env_ids)
    for env_id, hang in zip(group.group.env_ids[1:], hangs, strict=True):
        with pytest.raises(
            EnvHung, match=f"env '{env_id}'.*longer than {LIMIT} s for a step"
        ) as caught:
            group.step(tokens.steps(alive, {env_id: hang}))
        error = caught.value
        assert error.env_id == env_id
        assert error.exit_code == -signal.SIGKILL
        assert STACKS[hang] in error.stderr_tail
        assert "faulty.py" in error.stderr_tail
        assert error.results is not None
        tokens.check(error.results)
        alive.remove(env_id)
        tokens.check(group.step(tokens.steps(alive))[0])


@kinds_on_both_drivers("hangs", [*STACKS, "stop"])
def test_hung_step_is_answered_by_its_replacement(
    start: Start, hangs: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    """Each env that owed a reply gets one marked result; then every env replies again.

    The stacks, which no error has, are on stderr.
    """
    group, tokens = start(two_workers(step_timeout=LIMIT)), Tokens()
    for hang in hangs:
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-1": hang}))
        results = batch.values()
        assert marked(results[1])
        assert results[1].info["worker_restarted"] == "hung in a step and was killed"
        assert not marked(results[2])
        assert not marked(results[3])
        for _ in range(3):
            batch, _ = group.step(tokens.steps(group.group.env_ids))
        tokens.check(batch)
    written = capfd.readouterr().err
    for hang in hangs:
        assert STACKS.get(hang, "") in written


def test_hung_reset_is_found_by_its_own_limit(start: Start) -> None:
    """Steps have no limit if only resets have one."""
    group, tokens = start(two_workers(reset_timeout=LIMIT)), Tokens()
    group.call("faulty-3", "arm", "resetting", "deadlock")
    group.step_async(tokens.steps(["faulty-0"]))
    batch, _ = group.reset(env_ids=["faulty-2", "faulty-3"])
    assert marked(batch["faulty-3"])
    assert batch["faulty-3"].info["worker_restarted"] == "hung in a reset and was killed"
    tokens.check(group.collect_async()[0])


def test_hang_is_ended_though_the_fork_server_has_hung_as_well(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fork server can't kill the worker, so it is killed with all of its workers."""
    monkeypatch.setattr(times, "OBEY", LIMIT)
    group, tokens = start(two_workers(step_timeout=LIMIT)), Tokens()
    stop(pid_of(group, "faulty-0"))
    stop(fork_server_pid(group.group))
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    assert [marked(ret) for ret in batch.values()] == [True, True, False, False]
    assert batch["faulty-0"].info["worker_restarted"] == "hung in a step and was killed"
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    assert [marked(ret) for ret in batch.values()] == [False, False, True, True]
    innocent = batch["faulty-2"].info
    assert "its fork server: it didn't react" in innocent["worker_restarted"]
    assert (innocent["outcome"].blame, "env_at_fault" in innocent) == ("infrastructure", False)
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


def test_hang_is_found_while_others_leave_the_trainer_no_time_to_wait(start: Start) -> None:
    """Results that are always ready must not hide one that never comes."""
    group, tokens = start(two_workers(step_timeout=LIMIT)), Tokens()
    group.step_async(tokens.steps(["faulty-0"], {"faulty-0": "sleep"}))
    until = time.monotonic() + HANG
    found: dict[str, Any] = {}
    while "faulty-0" not in found and time.monotonic() < until:
        group.step_async(tokens.steps(["faulty-2", "faulty-3"]))
        while group.group._core.requests.in_flight[1]:
            group.group._core.waiting.poll()  # With this, the collect finds enough results.
        batch, _ = group.collect_async(min_results=2)
        found = dict(batch.items())
    assert marked(found["faulty-0"])


def test_a_trainer_that_reads_megabytes_late_takes_no_worker_for_hung(start: Start) -> None:
    """A worker can't continue before its reply is read; that time doesn't count, either."""
    group, tokens = start(two_workers(step_timeout=LIMIT)), Tokens()
    pids = [pid_of(group, env_id) for env_id in ("faulty-0", "faulty-2")]
    for env_id in group.group.env_ids:
        group.call(env_id, "answer_with", info=lambda: {"cargo": np.ones(2**23, np.uint8)})
    group.step_async(tokens.steps(group.group.env_ids))
    for worker in range(2):
        wait_for_reply(group.group, worker)
    threading.Event().wait(2 * LIMIT)  # The trainer has other things to do.
    for pid in pids:
        stop(pid)  # The worker needs a moment to continue.
    with pytest.raises(TimeoutError):
        group.collect_async(deadline=0.05)
    assert not any_killed(group.group)
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    batch, _ = group.collect_async(wait_all=True)
    assert not any_killed(group.group)
    assert [ret.info["cargo"].sum() for ret in batch.values()] == 4 * [2**23]
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


async def test_an_unread_reply_while_the_loop_is_busy_is_no_hang() -> None:
    """The worker was idle at the last check, and has replied since."""
    tokens = Tokens()
    async with rlightning_aio.build_env_group(entry(1, step_timeout=LIMIT)) as group:
        batch, _ = await group.reset()
        pid = int(batch["faulty-0"].observation[1])
        # Text doesn't fit in a row, so the reply comes through the channel.
        await group["faulty-0"].call("answer_with", info=lambda: {"word": "late"})
        (host,) = group._core.supervisor.hosts  # No public name says that a worker is idle.
        while host.current_request()[0]:
            os.sched_yield()
        stop(pid)
        group.step_async(tokens.steps(group.env_ids))
        with pytest.raises(TimeoutError):
            await group.collect_async(deadline=0.05)
        os.kill(pid, signal.SIGCONT)
        wait_for_reply(group, 0)
        threading.Event().wait(2 * LIMIT)  # The loop has other things to do.
        batch, _ = await group.collect_async()
        assert batch["faulty-0"].info == {"word": "late"}
        assert not any_killed(group)


@pytest.mark.parametrize("stopped", [False, True])
def test_worker_that_hangs_or_stops_behind_megabytes_is_found(start: Start, stopped: bool) -> None:
    """The trainer waits and reads; once there is nothing to read, the time runs on."""
    group, tokens = start(two_workers(step_timeout=LIMIT)), Tokens()
    pid = pid_of(group, "faulty-0")
    group.call("faulty-0", "answer_with", info=lambda: {"cargo": np.ones(2**23, np.uint8)})
    group.step_async(tokens.steps(["faulty-0", "faulty-1"], {"faulty-1": "sleep"}))
    wait_for_reply(group.group, 0)
    if stopped:
        stop(pid)
    batch, _ = group.collect_async(wait_all=True)
    assert marked(batch["faulty-0"]) == stopped
    assert marked(batch["faulty-1"])
    cause = batch["faulty-1"].info["worker_restarted"]
    assert cause == "hung in a step and was killed"
    tokens.check(group.step(tokens.steps(["faulty-1", "faulty-2"]))[0])


@on_one_driver
def test_start_that_hangs_fails_with_the_stack(build: Start) -> None:
    """`init` reports the limit and the position in the constructor."""
    kwargs = {"faults": {"building": "deadlock"}, "only": 3}
    group = build(two_workers(env_kwargs=kwargs, start_timeout=10))
    with pytest.raises(StartFailed, match=r"faulty-3.*did not start within 10") as caught:
        group.init()
    assert "in _deadlock" in str(caught.value)


@on_one_driver
def test_a_fork_server_that_hangs_in_an_import_fails_the_start(
    build: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It reads no messages while it imports, so it is killed; the error names the modules."""
    backend = registry.Backend(
        "faulty", "kit.faulty:FaultyEnv", "faults", preload=("faults.hanging_import",)
    )
    monkeypatch.setitem(registry.BACKENDS, "faulty", backend)
    group = build(entry(start_timeout=LIMIT))
    with pytest.raises(StartFailed, match=f"did not start within {LIMIT} s") as caught:
        group.init()
    assert "faults.hanging_import" in str(caught.value)


def test_replacement_that_hangs_is_replaced_until_there_are_too_many(
    start: Start, tmp_path: Path
) -> None:
    """`start_timeout` also applies to restarts."""
    broken = tmp_path / "broken"
    kwargs = {"faults": {"building": "sleep"}, "while_exists": str(broken)}
    config = two_workers(env_kwargs=kwargs, max_restarts=1)
    group, tokens = start(config), Tokens()
    for member in group.group._core.supervisor.records:
        member.config = member.config.model_copy(update={"start_timeout": LIMIT})
    broken.touch()
    with pytest.raises(WorkerDied, match=f"did not start again within {LIMIT} s") as caught:
        group.step(tokens.steps(["faulty-0"], {"faulty-0": "exit 3"}))
    assert "in __init__" in caught.value.stderr_tail
    tokens.check(group.step(tokens.steps(["faulty-2"]))[0])


@on_one_driver
def test_signals_that_the_trainer_blocks_reach_its_workers(build: Start) -> None:
    """Whatever the starting thread blocks: deaths are noticed at once, hangs show their stacks, and
    SIGTERM ends a worker.
    """
    every = signal.valid_signals() - {signal.SIGINT, signal.SIGALRM}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, every)
    try:
        alone = entry(3, envs_per_process=1, step_timeout=LIMIT, on_worker_death="raise")
        group, tokens = build(alone), Tokens()
        group.init()
        group.reset()
        for env_id, fault in (("faulty-0", "sigkill"), ("faulty-1", "sigterm")):
            with pytest.raises(WorkerDied, match=f"was killed by {fault.upper()}"):
                group.step(tokens.steps([env_id], {env_id: fault}))
        with pytest.raises(EnvHung, match="faulty-2") as caught:
            group.step(tokens.steps(["faulty-2"], {"faulty-2": "sleep"}))
        assert STACKS["sleep"] in caught.value.stderr_tail
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
