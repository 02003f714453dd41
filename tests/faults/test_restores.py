"""A restore in which a worker dies, or that nobody waits for."""

from __future__ import annotations

import asyncio
import os
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.scripted import Saved

import rlightning_aio as rl
from rlightning_aio.errors import WorkerDied

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


ENTRY: dict[str, Any] = {"name": "e", "task": Deadly, "num_workers": 4, "envs_per_process": 2}


def counts(batch: Any) -> list[int]:
    return batch.observation[:, 0].tolist()


@on_one_driver
@pytest.mark.parametrize("deadly", ["e-0", "e-1"])
def test_the_envs_of_a_worker_that_dies_in_a_restore_begin_anew(start: Start, deadly: str) -> None:
    """Also one that had been restored; those of other workers are restored."""
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
    shown = caught.value.results
    assert shown is not None
    restored = dict(zip(shown.ids(), counts(shown), strict=True))
    assert restored.items() >= {"e-2": 1, "e-3": 1}.items()
    with group.group.auto_reset(5):
        batch, _ = group.step(batch.respond(action=[0] * 4))
        assert counts(batch) == [0, 0, 2, 2]
        assert batch.restarted.tolist() == [True, True, False, False]
        batch, _ = group.restore(snapshot)  # Also into the replacement.
        assert (counts(batch), batch.restarted.any()) == ([1] * 4, False)
        for count in range(2, 6):
            batch, at_limit = group.step(batch.respond(action=[0] * 4))
            assert (counts(batch), at_limit) == ([count] * 4, [count == 5] * 4)


class Slow(Saved):
    """A pipe gets word that it has begun to load a state, and says when it has loaded it."""

    def __init__(self, begun: Path) -> None:
        super().__init__()
        self.begun = begun

    def load_state(self, state: Any) -> None:
        with self.begun.open("w") as pipe:
            pipe.write("begun")
        self.begun.read_text()
        super().load_state(state)


async def test_a_cancelled_restore_leaves_its_results_to_the_collector(tmp_path: Path) -> None:
    os.mkfifo(begun := tmp_path / "begun")
    entry = {"name": "e", "task": partial(Slow, begun), "placement": "process"}
    async with rl.build_env_group(entry) as group:
        batch, _ = await group.reset()
        batch, _ = await group.step(batch.respond(action=[0]))
        snapshot = await group.snapshot()
        batch, _ = await group.step(batch.respond(action=[0]))
        restoring = asyncio.create_task(group.restore(snapshot))
        await asyncio.to_thread(begun.read_text)
        restoring.cancel()
        with pytest.raises(asyncio.CancelledError):
            await restoring
        assert group.pending == ["e-0"]
        await asyncio.to_thread(begun.write_text, "go on")
        batch, _ = await group.collect_async()
        assert (counts(batch), batch.is_reset.tolist()) == ([1], [True])
        assert not batch.restarted.any()
