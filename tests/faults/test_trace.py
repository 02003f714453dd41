"""Workers that hang and die, as a timeline shows them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.processes import kill, pid_of
from kit.tokens import Tokens, two_workers
from patience import HANG
from timelines import Seen

from rlightning_aio.errors import WorkerDied

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Start: TypeAlias = Callable[..., Driven]


def marks(seen: Seen) -> list[tuple[str, str]]:
    return [(name, track) for name, _, track, _ in seen.marks]


@on_one_driver
def test_hangs_deaths_and_restarts_are_marked(start: Start, tmp_path: Path) -> None:
    """With their cause, and the time until the worker was replaced."""
    group, tokens = start(two_workers(step_timeout=1.0)), Tokens()
    trace: Any = group.group.trace(tmp_path / "run.json")
    with trace:
        group.step(tokens.steps(group.group.env_ids, {"faulty-1": "sleep"}))
        kill(pid_of(group, "faulty-2"))
        for _ in range(2):
            group.step(tokens.steps(group.group.env_ids))
    seen = Seen(tmp_path / "run.json")
    found = marks(seen)
    assert found.count(("hung", "faulty-1")) == 1
    # Those of a worker are shown at the first of its envs.
    assert sorted(track for name, track in found if name == "died") == ["faulty-0", "faulty-2"]
    assert sorted(track for name, track in found if name == "up") == ["faulty-0", "faulty-2"]
    (hung,) = seen.called("step, unfinished")
    assert hung.track == "faulty-1"
    assert hung.ended - hung.began >= 1e9
    causes = {args["cause"] for name, _, _, args in seen.marks if name == "died"}
    assert "hung in a step and was killed" in causes


@on_one_driver
@pytest.mark.parametrize("limits", [{}, {"step_timeout": HANG}], ids=["no limit", "a limit"])
def test_an_unfinished_request_begins_when_its_env_begins_it(
    start: Start, limits: dict[str, Any], tmp_path: Path
) -> None:
    """Not when it was sent; what waits behind it is not shown, and the timeline ends with it."""
    group, tokens = start(two_workers(on_worker_death="raise", **limits)), Tokens()
    env_ids = group.group.env_ids
    with group.group.trace(tmp_path / "run.json"):
        steps = tokens.steps(env_ids, {"faulty-1": "sleep"})
        group.step_async(steps)
        group.collect_async(min_results=3)
        time.sleep(0.01)
    seen = Seen(tmp_path / "run.json")
    (stuck,) = seen.called("step, unfinished")
    assert stuck.track == "faulty-1"
    (before,) = seen.of("faulty-0")
    assert stuck.began >= before.ended
    assert stuck.ended == max(one.ended for one in seen.slices)
    assert stuck.ended >= stuck.began + 10_000_000
    kill(group.get_workers()[0]["pid"])
    with pytest.raises(WorkerDied):
        group.collect_async(wait_all=True)


@on_one_driver
def test_a_worker_that_is_given_up_is_marked(start: Start, tmp_path: Path) -> None:
    group, tokens = start(two_workers(on_worker_death="raise")), Tokens()
    with group.group.trace(tmp_path / "run.json"):
        group.step_async(tokens.steps(group.group.env_ids))
        group.collect_async(wait_all=True)
        group.step_async(tokens.steps(group.group.env_ids, {"faulty-3": "sleep"}))
        kill(group.get_workers()[1]["pid"])
        with pytest.raises(WorkerDied):
            group.collect_async(wait_all=True)
    assert ("given up", "faulty-2") in marks(Seen(tmp_path / "run.json"))
