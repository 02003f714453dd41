"""A restore in which a worker dies puts all envs back; `group/test_core.py` has each moment."""

from __future__ import annotations

import asyncio
import os
import signal
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.processes import kill
from kit.scripted import Saved

import rlightning_aio as rl
from rlightning_aio.errors import EnvBusy, WorkerDied

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

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


class Endless(Saved):
    """The first time it never has loaded a state; a pipe gets word that it has begun to."""

    def __init__(self, begun: Path) -> None:
        super().__init__()
        self.begun = begun

    def load_state(self, state: Any) -> None:
        if self.begun.exists():
            with self.begun.open("w") as pipe:
                self.begun.unlink()
                pipe.write("begun")
            signal.pause()
        super().load_state(state)


async def test_a_death_after_a_cancelled_restore_resumes_nothing(tmp_path: Path) -> None:
    """The next step begins a new episode, as without the death; not the one before the restore."""
    os.mkfifo(begun := tmp_path / "begun")
    entry = {"name": "e", "task": partial(Endless, begun), "placement": "process"}
    entry |= {"on_worker_death": "resume", "snapshot_every": 1}
    async with rl.build_env_group(entry) as group:
        batch, _ = await group.reset()
        for _ in range(2):
            batch, _ = await group.step(batch.respond(action=[0]))
        restoring = asyncio.create_task(group.restore(await group.snapshot()))
        await asyncio.to_thread(begun.read_text)
        restoring.cancel()
        with pytest.raises(asyncio.CancelledError):
            await restoring
        (worker,) = group.get_workers()
        kill(worker["pid"])
        while True:
            try:
                batch, _ = await group.step(batch.respond(action=[0]))
                break
            except EnvBusy:  # Nobody has heard of its death.
                await asyncio.sleep(0)
        assert (counts(batch), batch.restarted.tolist()) == ([0], [True])
        assert "worker_resumed" not in batch.info()[0]
