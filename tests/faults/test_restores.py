"""A restore in which a worker dies puts all envs back; `group/test_core.py` has each moment."""

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
    "on_worker_death": "resume",
    "snapshot_every": 2,
}


def counts(batch: Any) -> list[int]:
    return batch.observation[:, 0].tolist()


@on_one_driver
@pytest.mark.parametrize("deadly", ["e-0", "e-1"])
def test_the_envs_of_a_worker_that_dies_in_a_restore_resume_what_was_not_restored(
    start: Start, deadly: str
) -> None:
    """Also those that had loaded the snapshot's state; and the others know where they are."""
    group = start(ENTRY)
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
