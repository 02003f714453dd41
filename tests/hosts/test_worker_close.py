"""A worker that gets `CLOSE` while requests still wait."""

from __future__ import annotations

import socket

import numpy as np
from protocol.memory_of_rings import both_sides

from rlightning_aio._core.hosts.completion_frames import completion_in
from rlightning_aio._core.hosts.messages import Closed
from rlightning_aio._core.hosts.process.worker import Worker
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.frames import FrameKind, FrameReader, encode


def test_a_close_comes_before_waiting_requests() -> None:
    """A close that is read before a request in the ring begins ends the worker in good order."""
    _, trainer, rings = both_sides(1)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        worker = Worker(theirs, -1, rings, 0)
        worker._attached = True
        trainer.request(np.array([entry(1, 0, Operation.STEP)]))
        ours.send(encode(FrameKind.CLOSE))
        trainer.count_frame()
        worker.serve()
        replies = FrameReader().feed(ours.recv(1 << 16))
        assert [completion_in(0, frame) for frame in replies] == [Closed(0, [])]
