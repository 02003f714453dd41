"""A worker of several awaitable envs that dies: the one whose code ran is at fault, or nobody."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.processes import kill
from kit.scripted import BLOCK, DIE, DIE_LATER, GO, HANG, Awaited

import rlightning_aio as rl

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


def waits(num_workers: int = 4, **fields: Any) -> dict[str, Any]:
    config = {"name": "w", "task": Awaited, "num_workers": num_workers}
    return {**config, "envs_per_process": num_workers, **fields}


def steps(actions: dict[str, int]) -> rl.BatchedData:
    values = [rl.PolicyResponse(env_id, action) for env_id, action in actions.items()]
    return rl.BatchedData([*actions], values)


def let_wait(group: Driven, *env_ids: str) -> None:
    """Have steps of these envs wait for ever; return when all of them do."""
    group.step_async(steps(dict.fromkeys(env_ids, HANG)))
    while group.call("w-3", "num_waiting") < len(env_ids):
        pass


def results_of(group: Driven, count: int) -> dict[str, Any]:
    """Collect as many results."""
    found: dict[str, Any] = {}
    while len(found) < count:
        found.update(group.collect_async()[0].items())
    return found


def test_of_envs_that_only_waited_nobody_is_named(start: Start) -> None:
    """The machine may be at fault as well as any of them."""
    group = start(waits())
    let_wait(group, "w-0", "w-2")
    kill(group.group.get_workers()[0]["pid"])
    found = results_of(group, 2)
    found.update(group.step(steps({"w-1": GO}))[0].items())
    assert {*found} == {"w-0", "w-1", "w-2"}
    for ret in found.values():
        assert ret.info["worker_restarted"].startswith("was killed by SIGKILL")
        assert "env_at_fault" not in ret.info
        outcome = ret.info["outcome"]
        assert (outcome.kind, outcome.blame) == ("env_died", "infrastructure")


@on_one_driver
@pytest.mark.parametrize("dies", [DIE, DIE_LATER])
def test_the_error_of_a_worker_that_is_not_replaced_names_them(start: Start, dies: int) -> None:
    """It is one error for all that owed a reply, which are busy until it is raised."""
    group = start(waits(8, envs_per_process=4, on_worker_death="raise"))
    let_wait(group, "w-0", "w-1")
    group.step_async(steps({"w-2": dies}))
    while group.group.get_workers()[0]["state"] == "up":
        group.step(steps({"w-4": GO}))
    for env_id in ("w-0", "w-1", "w-2"):
        with pytest.raises(rl.EnvBusy, match=f"'{env_id}'.*error that was not collected"):
            group.step_async(steps({env_id: GO}))
    assert group.group.pending == ["w-0", "w-1", "w-2"]
    with pytest.raises(rl.WorkerDied, match="exited with code 3") as caught:
        group.collect_async()
    error = caught.value
    assert sorted(error.env_ids) == ["w-0", "w-1", "w-2"]
    if dies == DIE:
        assert (error.env_id, error.outcome.blame) == ("w-2", "env")
    else:
        assert (error.env_id, error.outcome.blame) == ("w-0", "infrastructure")
        assert "no env's code was running" in str(error)
    assert group.group.pending == []
    batch, _ = group.step(steps({"w-1": GO}))
    assert batch.restarted.all()


@on_one_driver
def test_the_env_that_blocks_the_event_loop_has_hung(start: Start) -> None:
    """Whoever was asked before."""
    group = start(waits(step_timeout=0.5, on_worker_death="raise"))
    with pytest.raises(
        rl.EnvHung, match=r"env 'w-1'.* took longer than 0\.5 s for a step"
    ) as caught:
        group.step(steps({"w-0": GO, "w-1": BLOCK, "w-2": GO}))
    assert caught.value.env_id == "w-1"
