"""`collect_async` on real workers, whose envs step when the test opens their gates.

Random programs show how many results a collect returns, and that it loses none. Rules that need an
exact order of events and a clock are in `tests/simulator/test_moments.py`.
"""

from __future__ import annotations

import asyncio
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pytest_asyncio
from group.sample_envs import Gate

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio import (
    BatchedData,
    PolicyResponse,
)
from rlightning_aio.errors import GroupClosed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

IDS = [f"gated-{k}" for k in range(4)]


def responses(*indices: int) -> BatchedData:
    ids = [IDS[k] for k in indices]
    return BatchedData(
        ids, [PolicyResponse(id_, [0, k]) for k, id_ in zip(indices, ids, strict=True)]
    )


@pytest.fixture
def gates(tmp_path: Path) -> list[Gate]:
    return [Gate(str(tmp_path), env_id).make() for env_id in IDS]


def entry(tmp_path: Path, **fields: Any) -> dict[str, Any]:
    return {
        "name": "gated",
        "backend": "gated",
        "task": "x",
        "num_workers": 4,
        "env_kwargs": {"gates": str(tmp_path)},
        **fields,
    }


@pytest_asyncio.fixture
async def group(tmp_path: Path, gates: list[Gate]) -> AsyncIterator[Any]:
    """Four envs, each in its own worker."""
    async with rlightning_aio.build_env_group(entry(tmp_path, envs_per_process=1)) as group:
        await group.reset()
        yield group


@pytest.fixture
def sync_group(tmp_path: Path, gates: list[Gate]) -> Iterator[Any]:
    """Four envs in one worker, which steps them in the order of the requests."""
    with rlightning_aio.sync.build_env_group(entry(tmp_path, envs_per_process=4)) as group:
        group.reset()
        yield group


@contextmanager
def opened(*gates: Gate) -> Iterator[None]:
    """Open the gates one after the other while the context is open."""
    opener = threading.Thread(target=lambda: [gate.open() for gate in gates])
    opener.start()
    yield
    opener.join()


async def open_gates(*gates: Gate) -> None:
    with opened(*gates):
        await asyncio.sleep(0)


# -- the rules, synchronously


def test_leftovers_of_a_collect_come_first(sync_group: Any, gates: list[Gate]) -> None:
    sync_group.step_async(responses(3, 1, 0))
    with opened(gates[3], gates[1], gates[0]):
        pass
    came: list[str] = []
    for size in (2, 1):
        batch, flags = sync_group.collect_async(min_results=2, max_results=2)
        assert len(batch) == len(flags) == size
        came += batch.ids()
    assert came == ["gated-1", "gated-3", "gated-0"]


def test_workers_are_described_with_what_they_are_doing(sync_group: Any, gates: list[Gate]) -> None:
    """The description has the env that steps, and the outstanding results, oldest first."""
    (worker,) = sync_group.get_workers()
    assert (worker["entry"], worker["env_ids"], worker["state"]) == ("gated", IDS, "up")
    assert (worker["owed"], worker["owed_seconds"]) == ([], 0.0)
    sync_group.step_async(responses(2))
    sync_group.step_async(responses(0, 1))
    with gates[2].held():
        (worker,) = sync_group.get_workers()
        assert worker["owed"] == ["gated-2", "gated-0", "gated-1"]
        assert worker["owed_seconds"] > 0
    assert sync_group.collect_async()[0].ids() == ["gated-2"]
    assert sync_group.get_workers()[0]["owed"] == ["gated-0", "gated-1"]
    with opened(*gates[:2]):
        assert len(sync_group.collect_async(wait_all=True)[0]) == 2


def test_waiting_for_all_ignores_a_window_and_says_so(sync_group: Any, gates: list[Gate]) -> None:
    """The collect returns all pending results."""
    sync_group.step_async(responses(0, 1, 2))
    with opened(*gates[:3]), pytest.warns(UserWarning, match="ignores timeout"):
        batch, _ = sync_group.collect_async(wait_all=True, timeout=0.001)
    assert sorted(batch.ids()) == IDS[:3]


def test_a_window_ends_while_others_are_pending(sync_group: Any, gates: list[Gate]) -> None:
    """The first result opens it; results that come later are left to the next call."""
    sync_group.step_async(responses(0, 1))
    with opened(gates[0]):
        batch, _ = sync_group.collect_async(timeout=0.05)
    assert batch.ids() == ["gated-0"]
    with opened(gates[1]):
        assert sync_group.collect_async(timeout=60)[0].ids() == ["gated-1"]


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({"timeout": 0}, "timeout must be a positive"),
        ({"timeout": -1.0}, "timeout must be a positive"),
        ({"timeout": float("nan")}, "timeout must be a positive"),
        ({"deadline": 0}, "deadline must be a positive"),
        ({"min_results": 0}, "min_results must be at least 1"),
        ({"max_results": 0}, "max_results must be at least 1"),
        ({"min_results": 3, "max_results": 2}, r"min_results \(3\) is above max_results \(2\)"),
    ],
)
def test_invalid_arguments_are_refused(rules: dict[str, Any], said: str) -> None:
    """The error has the argument's name and value."""
    config = {"name": "a", "backend": "probe", "task": "x", "placement": "inline"}
    with rlightning_aio.sync.build_env_group(config) as group:
        batch, _ = group.reset()
        group.step_async(batch.respond(action=np.zeros((1, 2))))
        with pytest.raises(ValueError, match=said):
            group.collect_async(**rules)
        assert len(group.collect_async()[0]) == 1


# -- awaited


async def test_closing_wakes_all_waiters(group: Any, gates: list[Gate]) -> None:
    """A collect and a step raise at once; the envs get time to close."""
    group.step_async(responses(0))
    waiting = [
        asyncio.create_task(group.collect_async()),
        asyncio.create_task(group.step(responses(1))),
    ]
    await asyncio.sleep(0)
    with gates[0].held(), gates[1].held():
        closing = asyncio.create_task(group.close())
        await asyncio.wait(waiting)
        assert not closing.done()
        for task in waiting:
            with pytest.raises(GroupClosed):
                task.result()
        with pytest.warns(UserWarning, match="did not close in time"):
            await closing
