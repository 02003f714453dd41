"""A worker's bells and its frames share one channel; neither may hide the other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.config import EnvConfig
from rlightning_aio.hosts.arena import Arena
from rlightning_aio.hosts.process import ProcessHost
from rlightning_aio.hosts.worker import StartOrder
from rlightning_aio.protocol import rings
from rlightning_aio.protocol.frames import BELL, FrameKind, encode

if TYPE_CHECKING:
    import socket


class Listener:
    """Inbox, watcher and fork server in one: it notes what it is told."""

    def __init__(self) -> None:
        self.done: list[int] = []
        self.channel: socket.socket | None = None

    def fork(self, host: ProcessHost, channel: socket.socket, arena: Any, order: Any) -> None:
        self.channel = channel

    def watch(self, source: Any) -> None: ...

    def unwatch(self, source: Any) -> None: ...

    def watch_writable(self, source: Any, wanted: bool) -> None: ...

    def on_reports(self, entries: np.ndarray) -> None:
        self.done += entries.tolist()

    def on_rest(self, host: Any, row: int, number: int, rest: bytes) -> None:
        self.done.append(rings.entry(number, row, rings.STEP))


def entries(number: int) -> np.ndarray:
    return np.array([rings.entry(number, row, rings.STEP) for row in range(2)])


def test_a_bell_that_is_read_along_with_a_frame_can_be_ordered_again() -> None:
    """Else the same order, made once more, would be taken for one that still stands."""
    config = EnvConfig(name="two", backend="gymnasium", task="CartPole-v1", num_workers=2)
    listener, arena = Listener(), Arena()
    order = StartOrder(config, None, (0, 1), (None, None), spins=False, core=None)
    everybody: Any = listener
    host = ProcessHost(0, 0, order, everybody, arena, everybody, everybody)
    host.start()
    assert listener.channel is not None
    worker = rings.WorkerRings(host._rings_memory, 2)
    rung: list[int] = []

    def ring() -> None:
        rung.append(len(listener.done))
        listener.channel.send(BELL)

    # Both are done, a bell is rung for them, and something goes beside the second.
    host.request(entries(1))
    assert not host.order(2)
    worker.serve(lambda request: True, ring)
    listener.channel.send(encode(FrameKind.INFO_SCHEMA, 0, 0, b"N."))  # None, pickled.
    worker.count_frame()
    listener.on_schema = lambda *told: None
    host.sweep()
    assert listener.done == entries(1).tolist()

    host.request(entries(2))
    assert not host.order(2)
    worker.serve(lambda request: True, ring)
    assert rung == [0, 2]

    host.release()
    listener.channel.close()
    arena.close()
