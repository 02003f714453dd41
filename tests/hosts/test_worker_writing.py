"""A worker that sends more than its channel has room for."""

from __future__ import annotations

import os
import socket
import threading
import time

from patience import HANG
from protocol.memory_of_rings import both_sides

from rlightning_aio._core.hosts.messages import Result
from rlightning_aio._core.hosts.process.worker import Worker
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.frames import FrameReader


def test_the_time_of_a_request_excludes_the_wait_for_the_trainer() -> None:
    """The trainer sees which request waits. Time passes for data that fits into the channel."""
    _, trainer, rings = both_sides(1)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        worker = Worker(theirs, -1, rings, 0)
        request, began = entry(1, 0, Operation.STEP), time.monotonic_ns()
        rings.begin(request, began)
        worker._post(Result(0, request, b"small"))
        assert trainer.current() == (request, began)
        large = Result(0, request, bytes(1 << 23))
        writing = threading.Thread(target=worker._post, args=[large])
        writing.start()
        until = time.monotonic() + HANG
        while trainer.current() != (request, 0) and time.monotonic() < until:
            os.sched_yield()
        waited_at = time.monotonic_ns()
        assert trainer.current() == (request, 0)
        reader, sizes = FrameReader(), []
        read_at = time.monotonic_ns()
        while len(sizes) < 2:
            sizes += [len(frame.payload) for frame in reader.feed(ours.recv(1 << 16))]
        writing.join()
        assert sizes == [5, 1 << 23]
        executing, since = trainer.current()
        assert executing == request
        assert since - began >= read_at - waited_at > 0
