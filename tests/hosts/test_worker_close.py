"""A worker that is told to close while requests still wait for it."""

from __future__ import annotations

import socket

import numpy as np
from protocol.memory_of_rings import both_sides

from rlightning_aio.hosts.worker import Worker
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.frames import FrameKind, FrameReader, encode


def test_closing_leaves_waiting_requests_alone() -> None:
    """A close that is heard before a request of the ring was begun ends the worker in order."""
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
        assert [frame.kind for frame in replies] == [FrameKind.CLOSED]
