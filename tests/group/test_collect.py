"""`collect_async` on real workers.

Random programs show how many results a collect returns, and that it loses none. Rules that need an
exact order of events and a clock are in `tests/simulator/test_moments.py`.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING, Any

import pytest
from kit.scripted import GO, HANG, Scripted
from patience import HANG as LONG

from rlightning_aio import BatchedData, PolicyResponse, build_env_group, sync
from rlightning_aio.errors import GroupClosed

if TYPE_CHECKING:
    from collections.abc import Iterator

ENTRY: dict[str, Any] = {"name": "e", "task": Scripted, "num_workers": 4}
IDS = [f"e-{k}" for k in range(4)]


def steps(**actions: int) -> BatchedData:
    """Steps of envs, by their numbers."""
    ids = [f"e-{name[1:]}" for name in actions]
    return BatchedData(ids, list(map(PolicyResponse, ids, actions.values())))


@pytest.fixture
def group() -> Iterator[Any]:
    """Four envs in one worker, which steps them in the order of the requests."""
    with sync.build_env_group({**ENTRY, "envs_per_process": 4}) as group:
        group.reset()
        yield group
        group.abort()


def test_leftovers_of_a_collect_come_first(group: Any) -> None:
    group.step_async(steps(e3=GO, e1=GO, e0=GO))
    while group.get_workers()[0]["owed"]:
        os.sched_yield()
    came: list[str] = []
    for size in (2, 1):
        batch, flags = group.collect_async(min_results=2, max_results=2)
        assert len(batch) == len(flags) == size
        came += batch.ids()
    assert came == ["e-1", "e-3", "e-0"]


class Slow(Scripted):
    """Takes longer than a trainer that has nothing to do stays awake."""

    def does(self, action: Any) -> None:
        time.sleep(0.1)
        super().does(action)


def test_a_result_is_returned_at_once_though_its_worker_goes_on() -> None:
    """In a step of another env, which may take any time."""
    with sync.build_env_group({**ENTRY, "task": Slow, "envs_per_process": 4}) as group:
        group.reset()
        group.step_async(steps(e0=GO, e1=HANG))
        assert group.collect_async(deadline=LONG)[0].ids() == ["e-0"]
        group.abort()


def test_workers_are_described_with_what_they_are_doing(group: Any) -> None:
    """The description has the env that steps, and the outstanding results, oldest first."""
    (worker,) = group.get_workers()
    assert (worker["entry"], worker["env_ids"], worker["state"]) == ("e", IDS, "up")
    assert (worker["owed"], worker["owed_seconds"]) == ([], 0.0)
    group.step_async(steps(e2=GO, e1=HANG))
    group.step_async(steps(e0=GO))
    assert group.collect_async()[0].ids() == ["e-2"]
    while not (worker := group.get_workers()[0])["owed_seconds"]:
        os.sched_yield()
    assert worker["owed"] == ["e-1", "e-0"]


def test_waiting_for_all_ignores_a_window_and_says_so(group: Any) -> None:
    """The collect returns all pending results."""
    group.step_async(steps(e0=GO, e1=GO, e2=GO))
    with pytest.warns(UserWarning, match="ignores timeout"):
        batch, _ = group.collect_async(wait_all=True, timeout=1e-9)
    assert sorted(batch.ids()) == IDS[:3]


def test_a_window_ends_while_others_are_pending(group: Any) -> None:
    """The first result opens it."""
    group.step_async(steps(e0=GO, e1=HANG))
    batch, _ = group.collect_async(timeout=0.05)
    assert batch.ids() == ["e-0"]


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({"timeout": 0}, "timeout must be a positive"),
        ({"timeout": -1.0}, "timeout must be a positive"),
        ({"timeout": float("nan")}, "timeout must be a positive"),
        ({"deadline": 0}, "deadline must be a positive"),
        ({"min_results": 0}, "min_results must be an int, at least 1"),
        ({"min_results": 4 / 2}, "min_results must be an int.*not 2.0"),
        ({"max_results": 0}, "max_results must be an int, at least 1"),
        ({"max_results": 4 / 2}, "max_results must be an int.*not 2.0"),
        ({"min_results": 3, "max_results": 2}, r"min_results \(3\) is above max_results \(2\)"),
    ],
)
def test_invalid_arguments_are_refused(rules: dict[str, Any], said: str) -> None:
    """The error has the argument's name and value."""
    with sync.build_env_group({**ENTRY, "placement": "inline"}) as group:
        batch, _ = group.reset()
        group.step_async(batch.respond(action=[GO] * 4))
        with pytest.raises(ValueError, match=said):
            group.collect_async(**rules)
        assert len(group.collect_async(wait_all=True)[0]) == 4


async def test_closing_wakes_all_waiters() -> None:
    """A collect and a step raise at once; the envs get time to close."""
    async with build_env_group(ENTRY) as group:
        await group.reset()
        group.step_async(steps(e0=HANG))
        waiting = [
            asyncio.create_task(group.collect_async()),
            asyncio.create_task(group.step(steps(e1=HANG))),
        ]
        await asyncio.sleep(0)
        first: Any = group._core.supervisor.hosts[0]  # noqa: SLF001
        while not first.current_request()[0]:  # noqa: ASYNC110  # Else it closes before the step.
            await asyncio.sleep(0.001)
        closing = asyncio.create_task(group.close())
        await asyncio.wait(waiting)
        assert not closing.done()
        for task in waiting:
            with pytest.raises(GroupClosed):
                task.result()
        with pytest.warns(UserWarning, match="did not close in time"):
            await closing
