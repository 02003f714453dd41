"""Readiness is a hint: a socket that is reported readable may have nothing to read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import zmq
from kit.counting import ClientThread, CountingEnv, look, served
from patience import HANG

from rlightning_aio import sync
from rlightning_aio._core.hosts.env_server import listener

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest


class LyingPoller:
    """Reports both sockets of a client as readable, whether they are or not."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._poller = client._poller

    def poll(self, wait_ms: int | None) -> list[tuple[Any, int]]:
        self._poller.poll(min(wait_ms or 1, 1))
        return [(self._client._dealer, zmq.POLLIN), (self._client._monitor, zmq.POLLIN)]


def test_spurious_readiness_disturbs_neither_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It arises if a connection breaks between poll and read; each request ends once."""
    count = 0

    def lying(is_readable: Callable[[Any], bool]) -> Callable[[Any], bool]:
        def asked(socket: Any) -> bool:
            nonlocal count
            count += 1
            return is_readable(socket) or count % 3 == 0

        return asked

    monkeypatch.setattr(listener, "is_readable", lying(listener.is_readable))
    with sync.build_env_group(served(heartbeat=60.0)) as group:
        thread = ClientThread(group["robots-0"].address, "c0", CountingEnv())
        batch, _ = group.reset()
        thread.client._poller = LyingPoller(thread.client)
        for step in range(1, 101):
            group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
            batch, _ = group.collect_async(deadline=HANG)
            assert batch.observation[0, 2] == step
        look(group)
        group.close()
        thread.join()
    assert count > 100
    assert thread.env.disconnects == 1
