"""Timelines of clients."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from kit.counting import ClientThread, CountingEnv, served
from patience import HANG
from timelines import Seen

from rlightning_aio import sync

if TYPE_CHECKING:
    from pathlib import Path


def test_clients_have_tracks_by_their_names(tmp_path: Path) -> None:
    """With their requests."""
    with sync.build_env_group(served(clients=["left", "right"])) as group:
        address = group["robots-0"].address
        threads = [ClientThread(address, name, CountingEnv()) for name in ("left", "right")]
        with group.trace(tmp_path / "run.json"):
            batch, _ = group.reset()
            for _ in range(5):
                group.step_async(batch.respond(action=np.zeros((2, 2), np.float32)))
                batch, _ = group.collect_async(wait_all=True, deadline=HANG)
        group.close()
        for thread in threads:
            thread.join()
    seen = Seen(tmp_path / "run.json")
    tracks = [track for process, track in seen.tracks if process.startswith("place robots-0/")]
    assert sorted(tracks) == ["robots-0/left", "robots-0/right"]
    for track in tracks:
        names = [one.name for one in seen.of(track)]
        assert names == ["reset", *["step"] * 5]
