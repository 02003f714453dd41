"""Timelines: their content agrees with what the group did, and nothing is left behind."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from timelines import Seen

import rlightning_aio
from rlightning_aio import sync
from rlightning_aio._core.group.timeline.records import KEPT, Records

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

POLES = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 3}
CARS = {"name": "car", "backend": "gymnasium", "task": "MountainCar-v0", "num_workers": 2}
INLINE = {"placement": "inline"}
ROUNDS = 40


@pytest.fixture(scope="module")
def group() -> Iterator[Any]:
    """Yield a group with envs of two layouts, in workers."""
    entries = [{**entry, "envs_per_process": 2} for entry in (POLES, CARS)]
    with sync.build_env_group(entries, mixed_actions=True) as group:
        yield group


def step(group: Any, batch: Any) -> None:
    group.step_async(batch.respond(action=np.zeros(len(batch), np.int64)))


def test_a_timeline_agrees_with_what_was_collected(group: Any, tmp_path: Path) -> None:
    """Every result is in it once, on its env's track, with the time of the statistics."""
    counted = dict.fromkeys(group.env_ids, 0)
    with group.trace(tmp_path / "run.json"), group.auto_reset(max_episode_steps=7):
        batch, _ = group.reset(seed=0)
        step(group, batch)
        for _ in range(ROUNDS):
            with group.span("policy"):
                batch, _ = group.collect_async(min_results=2)
            step(group, batch)
            for env_id in batch.env_ids():
                counted[env_id] += 1
        batch, _ = group.collect_async(wait_all=True)
        for env_id in batch.env_ids():
            counted[env_id] += 1
        stats = group.get_stats()
    seen = Seen(tmp_path / "run.json")
    for env_id, count in counted.items():
        assert len(seen.of(env_id)) == count + 1  # The first reset.
    assert seen.flows == len(seen.results())
    assert {one.name for one in seen.results()} == {"step", "reset"}
    steps = [(one.ended - one.began) / 1e3 for one in seen.called("step") if one.args]
    for percent in (50, 99):
        reported = stats["latency_us"]["step"][f"p{percent}"]
        assert np.percentile(steps, percent) == pytest.approx(reported, rel=0.02)
    limits = [track for name, _, track, _ in seen.marks if name == "step limit"]
    assert limits
    assert set(limits) == {env_id for env_id, count in counted.items() if count >= 7}
    assert len(seen.called("policy")) == ROUNDS
    assert len(seen.called("collect_async")) == ROUNDS + 1
    assert seen.called("waiting for work")
    assert seen.tracks == [
        ("trainer", "trainer"),
        *[("worker 0 (pole)", name) for name in ("worker", "pole-0")],
        *[("worker 1 (pole)", name) for name in ("worker", "pole-1", "pole-2")],
        *[("worker 2 (car)", name) for name in ("worker", "car-0", "car-1")],
    ]


def test_a_worker_waits_for_work_between_its_requests_alone(group: Any, tmp_path: Path) -> None:
    """No env of a worker steps while the worker waits."""
    batch, _ = group.reset()
    with group.trace(tmp_path / "run.json"):
        for _ in range(10):
            batch, _ = group.step(batch.respond(action=np.zeros(5, np.int64)))
    seen = Seen(tmp_path / "run.json")
    waits = seen.called("waiting for work")
    assert len(waits) == 9 * 3
    for wait in waits:
        for one in seen.results():
            apart = one.ended <= wait.began or one.began >= wait.ended
            assert apart or one.process != wait.process


def test_nothing_is_left_behind(group: Any, tmp_path: Path) -> None:
    """After a trace, nothing observes the core, and spans do nothing."""
    core = group._core
    trace = group.trace(tmp_path / "run.json")
    trace.start()
    assert core.observed.observer is trace
    trace.stop()
    trace.stop()
    assert core.observed.observer is None
    assert group.span("policy") is group.span("learner")
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_an_interrupted_run_leaves_a_whole_file(group: Any, tmp_path: Path) -> None:
    """With all events until the interrupt; another trace may follow."""
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt), group.trace(tmp_path / "run.json"):  # noqa: PT012
            batch, _ = group.reset()
            step(group, batch)
            raise KeyboardInterrupt
        group.collect_async(wait_all=True)
        assert len(Seen(tmp_path / "run.json").called("reset")) == 6


def test_a_file_that_cannot_be_written_is_refused_at_once(group: Any, tmp_path: Path) -> None:
    """The message has the file and the reason."""
    with pytest.raises(FileNotFoundError, match=r"there is no folder .*missing"):
        group.trace(tmp_path / "missing" / "run.json")
    with pytest.raises(FileExistsError, match="it is no regular file"):
        group.trace(tmp_path)
    with (
        group.trace(tmp_path / "run.json"),
        pytest.raises(RuntimeError, match="is being recorded already"),
    ):
        group.trace(tmp_path / "other.json").start()


@pytest.mark.one_driver_for_each_place
def test_closing_the_group_ends_its_trace(tmp_path: Path) -> None:
    """A trace may begin before the envs start; it has the steps of a single env."""
    group = sync.build_env_group({**POLES, **INLINE, "num_workers": 1})
    group.trace(tmp_path / "run.json").start()
    with group:
        batch, _ = group.reset()
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=[0]))
    seen = Seen(tmp_path / "run.json")
    assert [one.name for one in seen.of("pole-0")] == ["reset", "step", "step", "step"]
    assert [one.name for one in seen.of("trainer") if one.name != "hand out"] == [
        "init",
        "reset",
        *["step"] * 3,
    ]
    assert ("inline 0 (pole)", "pole-0") in seen.tracks


async def test_tasks_and_threads_have_tracks_of_their_own(tmp_path: Path) -> None:
    """Overlapping spans are on different tracks; a finished task leaves its track to the next."""

    def learn(group: Any) -> None:
        with group.span("learner"):
            pass

    async def policy(group: Any, begun: asyncio.Event, end: asyncio.Event) -> None:
        with group.span("policy"):
            begun.set()
            await end.wait()

    async with (
        rlightning_aio.build_env_group({**POLES, **INLINE}) as group,
        group.trace(tmp_path / "run.json"),
    ):
        for _ in range(2):
            begun, end = asyncio.Event(), asyncio.Event()
            beside = asyncio.create_task(policy(group, begun, end), name="beside")
            await begun.wait()
            with group.span("main"):
                await group.reset()
                end.set()
                await beside
            thread = threading.Thread(target=learn, args=(group,))
            thread.start()
            thread.join()
    seen = Seen(tmp_path / "run.json")
    of_trainer = [track for process, track in seen.tracks if process == "trainer"]
    assert of_trainer == ["trainer", "beside"]
    assert [one.name for one in seen.of("trainer")] == ["main", "reset", "hand out"] * 2
    assert [one.name for one in seen.of("beside")] == ["policy", "learner"] * 2


def test_the_newest_events_of_a_long_run_are_kept() -> None:
    """Memory is bounded, and the file says how much is missing."""
    records = Records()
    name = records.name("collect")
    count = 1000
    batches = 2 * KEPT // count
    for k in range(1, batches + 1):
        columns = np.full(count, k), np.full(count, k), np.full((count, 2), k)
        records.add_results(*columns, taken=k, lane=0)
    results = records.results()
    assert KEPT // 2 <= len(results.entries) <= KEPT + count
    assert results.taken[-1] == batches
    assert (results.entries == results.taken).all()
    assert records.complete_since == results.taken[0] - 1
    for k in range(2 * KEPT):
        records.add_span((name, 0, k, k + 1))
    assert len(records.spans()) == KEPT
    assert records.complete_since == KEPT + 1
