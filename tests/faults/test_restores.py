"""A restore during which something breaks puts all envs back, those of a dead worker excepted."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.processes import kill
from kit.scripted import Saved

from rlightning_aio.errors import WorkerDied

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


class Deadly(Saved):
    """Once it is prepared, it ends its worker when its state is restored."""

    is_prepared = False

    def prepare(self) -> None:
        self.is_prepared = True

    def load_state(self, state: Any) -> None:
        if self.is_prepared:
            os._exit(5)
        super().load_state(state)


ENTRY: dict[str, Any] = {
    "name": "e",
    "task": Deadly,
    "num_workers": 4,
    "envs_per_process": 2,
}
POLICIES: dict[str, dict[str, Any]] = {
    "raise": {"on_worker_death": "raise"},
    "restart": {"on_worker_death": "restart"},
    "resume": {"on_worker_death": "resume", "snapshot_every": 2},
}


def counts(batch: Any) -> list[int]:
    return batch.observation[:, 0].tolist()


def in_failed_restore(start: Start, policy: str, deadly: str) -> tuple[Driven, Any]:
    """Return a group whose envs have made 3 steps, and its last results; a restore of the state
    after 1 step has failed, because `deadly` has ended its worker.
    """
    group = start({**ENTRY, **POLICIES[policy]})
    batch, _ = group.reset()
    batch, _ = group.step(batch.respond(action=[0] * 4))
    snapshot = group.snapshot()
    group.call(deadly, "prepare")
    for _ in range(2):
        batch, _ = group.step(batch.respond(action=[0] * 4))
    with pytest.raises(WorkerDied, match="exited with code 5") as caught:
        group.restore(snapshot)
    assert deadly in caught.value.env_ids
    note = "nothing was restored: the other envs are where they were before"
    assert caught.value.__notes__ == [note]
    return group, batch


@pytest.mark.parametrize("deadly", ["e-0", "e-1"])
def test_a_worker_that_dies_for_good_in_a_restore_leaves_the_others_as_they_were(
    start: Start, deadly: str
) -> None:
    """Whether its other env was restored before it or would have been after it."""
    group, batch = in_failed_restore(start, "raise", deadly)
    with pytest.raises(WorkerDied, match="nothing was sent to e-0, e-1"):
        group.step(batch.take([0, 1]).respond(action=[0, 0]))
    healthy = ["e-2", "e-3"]
    shown, _ = group.restore(group.snapshot(healthy), healthy)
    assert counts(shown) == [3, 3]
    batch, _ = group.step(batch.take([2, 3]).respond(action=[0, 0]))
    assert counts(batch) == [4, 4]
    assert not batch.is_reset.any()


@on_one_driver
@pytest.mark.parametrize("deadly", ["e-0", "e-1"])
def test_the_envs_of_a_worker_that_is_replaced_in_a_restore_begin_a_new_episode(
    start: Start, deadly: str
) -> None:
    group, batch = in_failed_restore(start, "restart", deadly)
    batch, _ = group.step(batch.respond(action=[0] * 4))
    assert counts(batch) == [0, 0, 4, 4]
    assert batch.restarted.tolist() == [True, True, False, False]


@on_one_driver
@pytest.mark.parametrize("deadly", ["e-0", "e-1"])
def test_the_envs_of_a_worker_that_dies_in_a_restore_resume_what_was_not_restored(
    start: Start, deadly: str
) -> None:
    """Also those that had loaded the snapshot's state; and the others know where they are."""
    group, batch = in_failed_restore(start, "resume", deadly)
    with group.group.auto_reset(5):
        batch, _ = group.step(batch.respond(action=[0] * 4))
        assert counts(batch) == [2, 2, 4, 4]
        assert batch.restarted.tolist() == [True, True, False, False]
        assert [info["worker_resumed"] for info in batch.info()[:2]] == [1, 1]
        kill(group.get_workers()[1]["pid"])
        batch, _ = group.step(batch.respond(action=[0] * 4))
        assert counts(batch) == [3, 3, 3, 3]
        assert [info["worker_resumed"] for info in batch.info()[2:]] == [1, 1]
        batch, at_limit = group.step(batch.respond(action=[0] * 4))
        assert (counts(batch), at_limit) == ([4] * 4, [False] * 4)
        batch, at_limit = group.step(batch.respond(action=[0] * 4))
        assert (counts(batch), at_limit) == ([5] * 4, [True] * 4)
