"""Running out of memory while results are handed out loses no result."""

from __future__ import annotations

import pickle
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from group.fake_host import PLAIN, RAISES, SENDS_INFO, TERMINATES, FakeGroup
from group.sample_envs import ADDING

import rlightning_aio.sync
from rlightning_aio._core.group.engine.steps import CollectRules
from rlightning_aio._core.hosts.messages import Result
from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import EnvRaised
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType

COPYING = {
    "gather",
    "_part",
    "_out_of_band_of",
    "_observations",
    "_batch",
    "add_episodes",
    "sources",
}
"""Modules whose code makes a batch."""


@contextmanager
def out_of_memory(line: int) -> Iterator[list[bool]]:
    """Raise MemoryError at the n-th line that makes a batch; the list has an item if it did."""
    left = line
    struck: list[bool] = []

    def on_line(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal left
        left -= event == "line"
        if left == 0:
            struck.append(True)
            raise MemoryError
        return on_line

    def on_call(frame: FrameType, event: str, arg: Any) -> Any:
        code = frame.f_code
        ours = "/rlightning_aio/" in code.co_filename and code.co_name in COPYING
        return on_line if ours else None

    sys.settrace(on_call)
    try:
        yield struck
    finally:
        sys.settrace(None)


def content(results: tuple[BatchedData, Any]) -> str:
    """Return the content of a batch as plain data."""
    batch, flags = results
    sent = {name: batch.sent[name] for name in batch.sent}
    rows = (batch.is_reset, batch.limit_reached, batch.restarted, batch.done)
    values = [value.model_dump(exclude={"ts_env_sent_ns"}) for value in batch.values()]
    return repr((batch.ids(), values, rows, sent, flags))


def steps(*deeds: int) -> BatchedData:
    ids = [f"fake-{slot}" for slot in range(len(deeds))]
    return BatchedData(ids, [PolicyResponse(*pair) for pair in zip(ids, deeds, strict=True)])


def collected(group: FakeGroup) -> tuple[BatchedData, Any]:
    return group.begin(group.steps.collect(group.now, CollectRules(wait_all=True))).result()


def finish_all(group: FakeGroup) -> None:
    for host in group.hosts:
        while host.waiting:
            group.finish(host.first_slot + host.waiting[0][0])


def hard_to_collect() -> FakeGroup:
    """Make results wait that have infos out of band, an end, a limit, and a worker's death."""
    group = FakeGroup([2, 2])
    group.core.continuity.begin(2, on_done=True)
    for deeds in ((PLAIN, PLAIN, PLAIN, PLAIN), (SENDS_INFO, TERMINATES, SENDS_INFO, PLAIN)):
        if deeds[0] == SENDS_INFO:
            group.hosts[1].die()
            group.turn()
        group.steps.step_async(steps(*deeds), group.now)
        finish_all(group)
        if deeds[0] == PLAIN:
            collected(group)
    return group


def test_a_failed_collect_leaves_all_results_to_the_next() -> None:
    """Wherever and however often it fails, the results are the same."""
    group = hard_to_collect()
    expected = content(collected(group))
    group.close()
    assert "worker_restarted" in expected
    group = hard_to_collect()
    for line in range(1, 1000):
        with out_of_memory(line) as struck:
            try:
                results = collected(group)
            except MemoryError:
                continue
        break
    assert not struck
    assert line > 20
    assert content(results) == expected
    assert not group.core.pending()
    group.steps.step_async(steps(PLAIN, PLAIN, PLAIN, PLAIN), group.now)
    finish_all(group)
    assert len(collected(group)[0]) == 4
    group.close()


def test_a_failed_step_leaves_its_results_to_collect() -> None:
    """And its errors, which a collect raises first."""
    group = FakeGroup([2])
    running = group.begin(group.steps.step(steps(SENDS_INFO, RAISES), group.now))
    with out_of_memory(1):
        finish_all(group)
    with pytest.raises(MemoryError):
        running.result()
    with pytest.raises(EnvRaised, match="fake-1"):
        collected(group)
    (value,) = collected(group)[0].values()
    assert (value.env_id, value.info) == ("fake-0", {"steps": [0]})
    group.close()


def test_an_unreadable_info_raises_only_when_it_is_read() -> None:
    """Statistics read it where an episode ends; the result is handed out all the same."""
    group = FakeGroup([1])
    (host,) = group.hosts
    host._reply = lambda entry, *_, **__: host.answer(Result(host.host_id, entry, b"no pickle"))
    group.steps.step_async(steps(TERMINATES), group.now)
    host.slab.episode_length[0] = 1
    finish_all(group)
    batch, _ = collected(group)
    assert batch.done.tolist() == [True]
    with pytest.raises(pickle.UnpicklingError):
        batch.info()
    group.close()


@pytest.mark.parametrize("entry", [ADDING, ADDING | {"backend": "fresh", "task": "array"}])
def test_a_failed_step_of_a_single_env_leaves_its_result_to_collect(entry: dict[str, Any]) -> None:
    """Also if the env's own arrays are handed out."""
    with (
        rlightning_aio.sync.build_env_group(entry) as group,
        rlightning_aio.sync.build_env_group(entry) as untroubled,
    ):
        batch, _ = group.reset(seed=0)
        expected, _ = untroubled.reset(seed=0)
        for line in range(1, 1000):
            expected, _ = untroubled.step(expected.respond(action=np.array([line % 2])))
            with out_of_memory(line) as struck, suppress(MemoryError):
                batch, _ = group.step(batch.respond(action=np.array([line % 2])))
            if struck:
                batch, _ = group.collect_async()
            assert content((batch, None)) == content((expected, None))
            if not struck:
                break
        assert line > 10
