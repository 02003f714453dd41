"""A process host: what random programs seldom meet."""

from __future__ import annotations

import errno
import os
import signal
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock, patch

import pytest
from gymnasium import spaces
from kit.processes import kill, stop, wait_for_reply
from kit.scripted import Counts

from rlightning_aio import BatchedData, PolicyResponse, sync

if TYPE_CHECKING:
    from collections.abc import Iterator

MEGABYTES = 3 << 20
"""More characters than the channel has room for."""


class Told(Counts):
    """Its actions and observations are texts, which travel through the channel."""

    observation_space = action_space = spaces.Text(MEGABYTES)

    def does(self, action: str) -> float:
        return len(action)

    def observed(self) -> str:
        return "a text"


ENTRY: dict[str, Any] = {"name": "e", "num_workers": 2, "envs_per_process": 2}


@pytest.fixture
def group() -> Iterator[Any]:
    with sync.build_env_group(Told, **ENTRY) as group:
        group.reset()
        yield group


@pytest.fixture
def counting() -> Iterator[Any]:
    """Envs whose requests and replies are in rings."""
    with sync.build_env_group(Counts, **ENTRY) as group:
        yield group


def ask(group: Any, size: int) -> None:
    """Send a step with a text of this size to each env."""
    texts = [PolicyResponse(env_id, "x" * size) for env_id in group.env_ids]
    group.step_async(BatchedData(group.env_ids, texts))


def check(group: Any, size: int) -> None:
    """Collect the results of `ask`."""
    assert group.collect_async(wait_all=True)[0].reward.tolist() == [size] * 2


@pytest.mark.parametrize("code", [errno.ENOBUFS, errno.ENOMEM])
def test_data_that_the_system_has_no_memory_for_is_written_later(group: Any, code: int) -> None:
    """A call that has numbered its requests can't take them back."""
    host = group._core.supervisor.hosts[0]
    broken = Mock(wraps=host._socket, send=Mock(side_effect=OSError(code, "no memory")))
    with patch.object(host, "_socket", broken):
        ask(group, 7)
    broken.send.assert_called()
    check(group, 7)


def test_catching_up_reads_and_writes_and_returns_whether_anything_moved(group: Any) -> None:
    """Before a worker is judged: it replies to what it has got, as far as that is read."""
    host, pid = group._core.supervisor.hosts[0], group.get_workers()[0]["pid"]
    ask(group, 7)
    wait_for_reply(group, 0)
    assert host.catch_up()
    check(group, 7)
    stop(pid)
    while host.catch_up():
        pass
    ask(group, MEGABYTES)
    assert not host.catch_up()
    os.kill(pid, signal.SIGCONT)
    while not host.catch_up():
        os.sched_yield()
    check(group, MEGABYTES)


def kill_worker(group: Any) -> None:
    """Kill the worker, and read the report of that before all else."""
    host = group._core.supervisor.hosts[0]
    kill(host.pid)
    while host.pid is not None:
        host._fork_server.on_readable()


def test_a_reply_in_the_channel_that_came_before_a_death_counts(group: Any) -> None:
    ask(group, 7)
    wait_for_reply(group, 0)
    kill_worker(group)
    batch, _ = group.collect_async(wait_all=True)
    assert batch["e-0"].last_reward == 7


def test_replies_in_the_ring_that_came_before_a_death_count(counting: Any) -> None:
    batch, _ = counting.reset()
    counting.step_async(batch.respond(action=[0, 0]))
    while counting._core.waiting._bell.unread() < 2:
        os.sched_yield()
    kill_worker(counting)
    assert not counting.collect_async(wait_all=True)[0].restarted.any()


def test_a_worker_that_dies_before_it_begins_was_about_to_execute_the_first_request(
    counting: Any,
) -> None:
    """That env is named, though none was executed."""
    batch, _ = counting.reset()
    stop(counting.get_workers()[0]["pid"])
    counting.step_async(batch.take([1, 0]).respond(action=[0, 0]))
    kill_worker(counting)
    batch, _ = counting.collect_async(wait_all=True)
    assert batch.info("env_at_fault") == ["e-1"] * 2
