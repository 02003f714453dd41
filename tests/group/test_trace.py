"""Timelines: their content agrees with what the group did, and nothing is left behind."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from timelines import Seen

import rlightning_aio
from rlightning_aio import sync
from rlightning_aio._core.group import timeline

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
    """Every result is in it once, on its env's track, with the time in the env."""
    counted, busy = dict.fromkeys(group.env_ids, 0), list[int]()
    with group.trace(tmp_path / "run.json"), group.auto_reset(max_episode_steps=7):
        batch, _ = group.reset(seed=0)
        step(group, batch)
        for _ in range(ROUNDS):
            with group.span("policy"):
                batch, _ = group.collect_async(min_results=2)
            step(group, batch)
            busy += batch.busy_ns.tolist()
            for env_id in batch.env_ids():
                counted[env_id] += 1
        batch, _ = group.collect_async(wait_all=True)
        for env_id in batch.env_ids():
            counted[env_id] += 1
    seen = Seen(tmp_path / "run.json")
    for env_id, count in counted.items():
        assert len(seen.of(env_id)) == count + 1  # The first reset.
    assert {one.name for one in seen.results()} == {"step", "reset"}
    shown = Counter(one.ended - one.began for one in seen.results())
    assert not Counter(busy) - shown
    assert len(seen.called("policy")) == ROUNDS
    assert len(seen.called("collect_async")) == ROUNDS + 1
    assert set(seen.tracks) == {
        ("trainer", "trainer"),
        ("worker 0 (pole)", "pole-0"),
        *[("worker 1 (pole)", name) for name in ("pole-1", "pole-2")],
        *[("worker 2 (car)", name) for name in ("car-0", "car-1")],
    }


def test_a_result_that_nobody_has_collected_is_shown(group: Any, tmp_path: Path) -> None:
    """Its step has ended; it is not called unfinished."""
    batch, _ = group.reset()
    alone = [k for k, env_id in enumerate(batch.env_ids()) if env_id == "pole-1"]
    with group.trace(tmp_path / "run.json"):
        step(group, batch.take(alone))
        group["pole-2"].step(0)  # By the same worker, so that the other step has ended.
    assert [one.name for one in Seen(tmp_path / "run.json").of("pole-1")] == ["step"]
    group.collect_async()


def test_an_interrupted_run_leaves_a_whole_file(group: Any, tmp_path: Path) -> None:
    """With all events until the interrupt; another trace may follow."""
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt), group.trace(tmp_path / "run.json"):  # noqa: PT012
            batch, _ = group.reset()
            step(group, batch)
            raise KeyboardInterrupt
        group.collect_async(wait_all=True)
        seen = Seen(tmp_path / "run.json")
        assert len([one for one in seen.called("reset") if one.args]) == 5


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
    assert [one.name for one in seen.of("trainer")] == ["init", "reset", *["step"] * 3]
    assert ("inline 0 (pole)", "pole-0") in seen.tracks


async def test_slices_of_several_tasks_nest_or_get_a_track_of_their_own(tmp_path: Path) -> None:
    """A finished one leaves its track to the next."""

    def learn(group: Any) -> None:
        with group.span("learner"):
            pass

    async def policy(group: Any, begun: asyncio.Event, end: asyncio.Event) -> None:
        with group.span("policy"):
            begun.set()
            await end.wait()
            await asyncio.sleep(0.001)

    async with (
        rlightning_aio.build_env_group({**POLES, **INLINE}) as group,
        group.trace(tmp_path / "run.json"),
    ):
        for _ in range(2):
            begun, end = asyncio.Event(), asyncio.Event()
            with group.span("main"):
                beside = asyncio.create_task(policy(group, begun, end))
                await begun.wait()
                await group.reset()
                end.set()
            await beside
            thread = threading.Thread(target=learn, args=(group,))
            thread.start()
            thread.join()
    seen = Seen(tmp_path / "run.json")
    assert [track for process, track in seen.tracks if process == "trainer"] == [
        "trainer",
        "trainer 2",
    ]
    assert Counter(one.name for one in seen.of("trainer")) == {"main": 2, "learner": 2, "reset": 2}
    assert Counter(one.name for one in seen.of("trainer 2")) == {"policy": 2}


def test_the_newest_results_of_a_long_run_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded, and what is only half there is left out."""
    monkeypatch.setattr(timeline, "KEPT", 100)
    kept = timeline._Results()
    for k in range(0, 480, 7):
        assert kept.complete_since == max(10 * (k - 100), 0)
        numbers = np.arange(k, k + 7)
        kept.add(numbers, 10 * numbers, 10 * numbers, 1, size=7)
    rows = kept.all()
    assert rows[:, 0].tolist() == list(range(383, 483))
    assert (rows[:, 2] == 10 * rows[:, 0]).all()
