"""`placement: split`: workers and this process share the envs of an entry, but not their
failures.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeAlias

import pytest
from faults.driven import Driven, Tokens, entry, marked, pid_of
from faults.drivers import on_one_driver

from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


@on_one_driver
def test_the_last_share_lives_in_this_process(start: Start) -> None:
    """It has as many envs as a worker; of several entries, only the last one has such a share."""
    first = entry(3, placement="split", envs_per_process=2, name="first")
    group = start([first, entry(5, placement="split", envs_per_process=2)])
    pids = [pid_of(group, env_id) for env_id in group.group.env_ids]
    assert [pid == os.getpid() for pid in pids] == [False] * 6 + [True] * 2
    assert [len({*pids[:1], *pids[1:3]}), len({*pids[3:4], *pids[4:6]})] == [2, 2]
    assert len(set(pids)) == 5


@on_one_driver
def test_without_a_core_for_workers_all_envs_live_in_this_process(start: Start) -> None:
    """This process does the work of one worker."""
    group = start(entry(2, placement="split", envs_per_process=2))
    assert {pid_of(group, env_id) for env_id in group.group.env_ids} == {os.getpid()}


def test_death_of_a_worker_affects_only_its_own_envs(start: Start) -> None:
    """Those of this process continue to step."""
    group, tokens = start(entry(2, placement="split", envs_per_process=1)), Tokens()
    for _ in range(2):
        batch, _ = group.step(tokens.steps(group.group.env_ids, {"faulty-0": "exit 3"}))
        theirs, ours = batch.values()
        assert marked(theirs)
        assert theirs.info["worker_restarted"].startswith("exited with code 3")
        assert not marked(ours)
        tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


def test_error_on_one_side_loses_nothing_of_the_other(start: Start) -> None:
    """Whichever of the two raises."""
    group, tokens = start(entry(2, placement="split", envs_per_process=1)), Tokens()
    for env_id, other in (("faulty-0", "faulty-1"), ("faulty-1", "faulty-0")):
        with pytest.raises(EnvRaised, match=f"env '{env_id}'") as caught:
            group.step(tokens.steps(group.group.env_ids, {env_id: "raise"}))
        assert caught.value.results is not None
        assert caught.value.results.ids() == [other]
        tokens.check(caught.value.results)
        group.reset(env_ids=[env_id])
