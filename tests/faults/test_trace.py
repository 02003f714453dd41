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


@on_one_driver
def test_what_a_worker_executes_when_it_is_killed_is_unfinished(
    start: Start, tmp_path: Path
) -> None:
    """It hung; other workers, and what was idle, leave no slice."""
    group, tokens = start(two_workers(step_timeout=1.0)), Tokens()
    with group.group.trace(tmp_path / "run.json"):
        group.step(tokens.steps(group.group.env_ids, {"faulty-1": "sleep"}))
        kill(pid_of(group, "faulty-2"))
        for _ in range(2):
            group.step(tokens.steps(group.group.env_ids))
    (hung,) = Seen(tmp_path / "run.json").called("step, unfinished")
    assert hung.track == "faulty-1"
    assert hung.ended - hung.began >= 1e9


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
