"""Requests that nobody wants any more end soon, whatever their envs do."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from kit.driven import Driven, kinds_on_both_drivers, on_one_driver
from kit.processes import kill, pid_of
from kit.scripted import Counts
from kit.tokens import Tokens, entry, marked, two_workers

import rlightning_aio as rl
from rlightning_aio.errors import EpisodeLost

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Start: TypeAlias = Callable[..., Driven]

HANGS = ["sleep", "loop in C", "deadlock with the GIL", "stop"]


@kinds_on_both_drivers("hangs", HANGS)
def test_an_env_that_hangs_is_free_after_an_abort(start: Start, hangs: list[str]) -> None:
    """Its worker is replaced, though nothing has a time limit; others have noticed nothing."""
    group, tokens = start(entry(1 + len(hangs), envs_per_process=1)), Tokens()
    everyone = list(group.group.env_ids)
    alive = {env_id: pid_of(group, env_id) for env_id in everyone}
    for env_id, kind in zip(everyone[1:], hangs, strict=True):
        group.step_async(tokens.steps([env_id], {env_id: kind}))
    group.step_async(tokens.steps(everyone[:1]))
    group.abort(everyone[1:])
    tokens.check(group.collect_async()[0])
    assert group.group.pending == []
    batch, _ = group.step(tokens.steps(everyone))
    assert [marked(ret) for ret in batch.values()] == [False] + [True] * len(hangs)
    replaced = [pid_of(group, env_id) != alive[env_id] for env_id in everyone]
    assert replaced == [False] + [True] * len(hangs)
    tokens.check(group.step(tokens.steps(everyone))[0])


def test_envs_that_share_the_worker_lose_their_episodes_as_with_any_death(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    """Their results are marked, and name the env; a result that was ready stays what it was."""
    group, tokens = start(entry(4, envs_per_process=4)), Tokens()
    ids = group.group.env_ids
    group.step_async(tokens.steps(ids[:1]))
    assert group.collect_async(max_results=1)[0].ids() == ids[:1]
    group.step_async(tokens.steps(ids[:3], {ids[1]: "sleep"}))
    with caplog.at_level(logging.WARNING):
        group.abort(ids[1:2])
    assert "abort" not in caplog.text  # It is no fault.
    results = {}
    while len(results) < 2:
        batch, _ = group.collect_async(wait_all=True)
        results.update(batch.items())
    tokens.check(rl.BatchedData.from_dict({ids[0]: results[ids[0]]}))
    assert marked(results[ids[2]])
    cause = "was killed because a step was aborted"
    assert results[ids[2]].info["worker_restarted"] == cause
    assert results[ids[2]].info["env_at_fault"] == ids[1]
    batch, _ = group.step(tokens.steps([ids[0], ids[1], ids[3]]))
    assert all(marked(ret) for ret in batch.values())
    tokens.check(group.step(tokens.steps(ids))[0])


@on_one_driver
def test_a_drain_returns_what_comes_by_the_deadline_and_ends_the_rest(start: Start) -> None:
    group, tokens = start(entry(2, envs_per_process=1)), Tokens()
    ids = group.group.env_ids
    group.step_async(tokens.steps(ids, {ids[1]: "sleep"}))
    batch, _ = group.collect_async()  # However long that takes on a busy machine.
    group.step_async(tokens.steps(ids[:1]))
    assert group.drain(0.001)[0].ids() in ([], ids[:1])
    assert (batch.ids(), group.group.pending) == (ids[:1], [])
    batch, _ = group.step(tokens.steps(ids))
    assert batch.restarted[1]


def test_a_request_that_waits_for_a_replacement_is_withdrawn(start: Start, tmp_path: Path) -> None:
    """At once, however long the replacement takes to start; the others are answered by it."""
    switch = tmp_path / "switch"
    kwargs = {"faults": {"building": "sleep"}, "while_exists": str(switch), "only": 0}
    group, tokens = start(entry(3, env_kwargs=kwargs, max_restarts=5)), Tokens()
    ids = group.group.env_ids
    switch.touch()
    pid = group.get_workers()[0]["pid"]
    os.kill(pid, signal.SIGSTOP)  # It answers nothing before it is killed.
    group.step_async(tokens.steps(ids))
    kill(pid)
    while group.get_workers()[0]["pid"] in (None, pid):
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=0.01)
    group.abort(ids[:1])
    assert group.group.pending == ids[1:]
    switch.unlink()
    kill(group.get_workers()[0]["pid"])
    batch, _ = group.collect_async(wait_all=True)
    assert sorted(batch.ids()) == ids[1:]
    assert all(marked(ret) for ret in batch.values())
    batch, _ = group.step(tokens.steps(ids))
    assert batch.restarted.tolist() == [True, False, False]


async def test_a_wait_for_an_aborted_step_ends_though_nothing_else_happens() -> None:
    """A call that waits without a look at the clock is woken, even if the abort is cancelled."""
    tokens = Tokens()
    async with rl.build_env_group(two_workers()) as group:
        await group.reset()
        ids = group.env_ids
        stepping = asyncio.ensure_future(group.step(tokens.steps(ids, {ids[0]: "sleep"})))
        while group.get_workers()[1]["owed"] or not group.get_workers()[0]["owed"]:  # noqa: ASYNC110
            await asyncio.sleep(0)
        aborting = asyncio.ensure_future(group.abort([ids[0]]))
        await asyncio.sleep(0)
        aborting.cancel()
        with pytest.raises(EpisodeLost) as aborted:
            await stepping
        assert aborted.value.results.ids() == ids[1:]
        assert np.asarray(aborted.value.results.restarted).tolist() == [True, False, False]
        await asyncio.wait({aborting})


class Rests(Counts):
    def does(self, action: Any) -> None:
        self.rest(0.05 * action)

    def rest(self, seconds: float) -> None:
        time.sleep(seconds)


async def test_a_call_that_was_cancelled_is_not_ended_for_a_step_that_was_aborted() -> None:
    """Its env was free again by then, and the worker is not killed."""
    async with rl.build_env_group(rl.EnvConfig(task=Rests, num_workers=2)) as group:
        batch, _ = await group.reset()
        aborted = group.env_ids[0]
        group.step_async(batch.respond([1, 1]))
        await group.abort([aborted])
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(group[aborted].call("rest", 0.5), 0.01)
        batch, _ = await group.collect_async()
        while group.get_workers()[0]["owed"]:
            batch, _ = await group.step(batch.respond([1]))
        assert group.get_workers()[0]["restarts"] == 0
