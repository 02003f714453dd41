"""Memory that runs out while results are handed out costs no result."""

from __future__ import annotations

import pickle
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from group.fake_host import PLAIN, RAISES, TELLS, TERMINATES, FakeGroup
from group.sample_envs import HALVED

import rlightning_aio.sync
from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import EnvRaised
from rlightning_aio.hosts.messages import Result
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
"""What a batch is made in."""


@contextmanager
def out_of_memory(line: int) -> Iterator[list[bool]]:
    """At the n-th line that makes a batch; whether it came to that."""
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


def told(results: tuple[BatchedData, Any]) -> str:
    """All that can be told of a batch."""
    batch, flags = results
    sent = {name: batch.sent[name] for name in batch.sent}
    rows = (batch.is_reset, batch.limit_reached, batch.restarted, batch.done)
    values = [value.model_dump(exclude={"ts_env_sent_ns"}) for value in batch.values()]
    return repr((batch.ids(), values, rows, sent, flags))


def steps(*deeds: int) -> BatchedData:
    ids = [f"fake-{slot}" for slot in range(len(deeds))]
    return BatchedData(ids, [PolicyResponse(*pair) for pair in zip(ids, deeds, strict=True)])


def collected(group: FakeGroup) -> tuple[BatchedData, Any]:
    rules = {"timeout": None, "min_results": 1, "max_results": None, "deadline": None}
    return group.begin(group.core.collect(group.now, wait_all=True, **rules)).result()


def finish_all(group: FakeGroup) -> None:
    for host in group.hosts:
        while host.waiting:
            group.finish(host.first_slot + host.waiting[0][0])


def hard_to_collect() -> FakeGroup:
    """Results wait that have infos out of band, an end, a limit, and a worker's death to tell."""
    group = FakeGroup([2, 2])
    group.core.auto.begin(2, on_done=True, mark_truncated=True)
    for deeds in ((PLAIN, PLAIN, PLAIN, PLAIN), (TELLS, TERMINATES, TELLS, PLAIN)):
        if deeds[0] == TELLS:
            group.hosts[1].die()
            group.turn()
        group.core.step_async(steps(*deeds), group.now)
        finish_all(group)
        if deeds[0] == PLAIN:
            collected(group)
    return group


def test_a_collect_that_fails_leaves_all_results_to_the_next() -> None:
    """Wherever it fails, and however often: they are handed out as they would have been."""
    group = hard_to_collect()
    expected = told(collected(group))
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
    assert told(results) == expected
    assert group.core.pending() == 0
    group.core.step_async(steps(PLAIN, PLAIN, PLAIN, PLAIN), group.now)
    finish_all(group)
    assert len(collected(group)[0]) == 4
    group.close()


def test_a_step_that_fails_leaves_its_results_to_collect() -> None:
    """And its errors, which a collect raises first."""
    group = FakeGroup([2])
    running = group.begin(group.core.step(steps(TELLS, RAISES), group.now))
    with out_of_memory(1):
        finish_all(group)
    with pytest.raises(MemoryError):
        running.result()
    with pytest.raises(EnvRaised, match="fake-1"):
        collected(group)
    (value,) = collected(group)[0].values()
    assert (value.env_id, value.info) == ("fake-0", {"told": [0]})
    group.close()


def test_an_info_that_can_not_be_read_is_its_readers_trouble() -> None:
    """Statistics look into it where an episode ends, and the result is handed out all the same."""
    group = FakeGroup([1])
    (host,) = group.hosts
    host._reply = lambda entry, *_, **__: host.answer(Result(host.host_id, entry, b"no pickle"))
    group.core.step_async(steps(TERMINATES), group.now)
    host.slab.episode_length[0] = 1
    finish_all(group)
    batch, _ = collected(group)
    assert batch.done.tolist() == [True]
    with pytest.raises(pickle.UnpicklingError):
        batch.info()
    group.close()


@pytest.mark.parametrize("entry", [HALVED, HALVED | {"backend": "fresh", "task": "array"}])
def test_a_step_on_the_spot_that_fails_leaves_its_result_to_collect(entry: dict[str, Any]) -> None:
    """Also where the env's own arrays are handed out."""
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
            assert told((batch, None)) == told((expected, None))
            if not struck:
                break
        assert line > 10
