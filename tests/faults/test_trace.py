"""Workers that hang and die, as a timeline shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.processes import kill, pid_of
from kit.tokens import Tokens, two_workers
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
    assert found.count(("hung", "worker")) == 1
    assert found.count(("died", "worker")) == 2
    lost = [track for name, track in found if name == "episode lost"]
    assert sorted(lost) == [f"faulty-{k}" for k in range(4)]
    (hung,) = seen.called("step, hung")
    assert hung.track == "faulty-1"
    assert hung.ended - hung.began >= 1e9
    replaced = seen.called("being replaced")
    assert sorted(one.process for one in replaced) == ["worker 0 (faulty)", "worker 1 (faulty)"]
    causes = {args["cause"] for name, _, _, args in seen.marks if name == "died"}
    assert "hung in a step and was killed" in causes
    lost = [args for name, _, _, args in seen.marks if name == "episode lost"]
    kinds = sorted((args["kind"], args["blame"]) for args in lost)
    assert kinds[-1] == ("env_hung", "either")  # The others of its worker are not to blame.
    assert {kind for kind, _ in kinds[:-1]} == {"env_died"}
    assert all(args["cause"] for args in lost)


@on_one_driver
def test_requests_in_progress_at_the_end_are_shown(start: Start, tmp_path: Path) -> None:
    """A user who interrupts a hanging program sees in which env it hangs."""
    group, tokens = start(two_workers(on_worker_death="raise")), Tokens()
    with group.group.trace(tmp_path / "run.json"):
        group.step_async(tokens.steps(group.group.env_ids, {"faulty-3": "sleep"}))
        group.collect_async(min_results=3)
    (stuck,) = Seen(tmp_path / "run.json").called("step, not done")
    assert stuck.track == "faulty-3"
    with group.group.trace(tmp_path / "run.json"):
        kill(group.get_workers()[1]["pid"])
        with pytest.raises(WorkerDied):
            group.collect_async(wait_all=True)
    assert ("given up", "worker") in marks(Seen(tmp_path / "run.json"))
