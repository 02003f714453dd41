"""A worker that is told to close while requests still wait for it."""

from __future__ import annotations

import socket

import numpy as np

from rlightning_aio.hosts.worker import Worker
from rlightning_aio.protocol.frames import FrameKind, FrameReader, encode
from rlightning_aio.protocol.rings import STEP, TrainerRings, entry, rings_size


def test_closing_leaves_waiting_requests_alone() -> None:
    """A close that is heard before a request of the ring was begun ends the worker in order."""
    memory = memoryview(bytearray(rings_size(1)))
    ours, theirs = socket.socketpair()
    with ours, theirs:
        worker = Worker(theirs, -1, memory, 0, 1)
        worker._attached = True
        trainer = TrainerRings(memory, 1)
        trainer.request(np.array([entry(1, 0, STEP)]))
        ours.send(encode(FrameKind.CLOSE, 0, 0, b""))
        trainer.count_frame()
        worker.serve()
        replies = FrameReader().feed(ours.recv(1 << 16))
        assert [frame.kind for frame in replies] == [FrameKind.CLOSED]
