"""The bell, once it is released, and between processes.

That it rings in any order of events, random programs show, and `test_interleavings`.
"""

from __future__ import annotations

import mmap
import os
import random
import select
import socket
from typing import Any, NoReturn

import numpy as np
import pytest
from protocol.memory_of_rings import unused

from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.rings import (
    TrainerBell,
    TrainerRings,
    WorkerBell,
    WorkerRings,
    bell_size,
    rings_size,
)

pytestmark = pytest.mark.usefixtures("implementation")


def test_a_released_bell_is_silent() -> None:
    """Its memory may be gone, and it no longer reads it."""
    memory = memoryview(bytearray(bell_size(1)))
    trainer, worker = TrainerBell(memory, 1), WorkerBell(memory, 1, 0)
    worker.publish(3)
    trainer.release()
    assert trainer.unread() == 0
    assert trainer.with_news() == []
    trainer.arm(trainer.read[-1] + 1, at_last=False)
    worker.publish(4)
    assert not worker.is_due()


def _work(rings: WorkerRings, channel: socket.socket) -> None:
    """A worker without envs, which ends when the trainer closes the channel."""
    while True:
        ring, parts = lambda: channel.send(b"!"), (unused, [], 0, rings.fence)
        if kernel.serve(rings.side, lambda _: True, unused, ring, *parts):
            continue
        if rings.fall_asleep():
            if not channel.recv(1 << 16):
                return
            rings.wake_up()


def _work_and_exit(
    bell: memoryview,
    num_workers: int,
    index: int,
    rings: memoryview,
    num_envs: int,
    channel: socket.socket,
    others: list[socket.socket],
) -> NoReturn:
    try:
        for other in others:
            other.close()
        _work(WorkerRings(rings, num_envs, WorkerBell(bell, num_workers, index)), channel)
    finally:
        os._exit(0)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("num_workers", "rounds"), [(1, 2000), (3, 1500), (13, 300)])
def test_a_trainer_of_several_processes_is_never_left_asleep(num_workers: int, rounds: int) -> None:
    """In thousands of rounds with workers that finish nearly together."""
    envs = 4
    bell_bytes, ring_bytes = bell_size(num_workers), rings_size(envs)
    memory = memoryview(mmap.mmap(-1, bell_bytes + num_workers * ring_bytes))
    bell = TrainerBell(memory[:bell_bytes], num_workers)
    parts = [memory[bell_bytes + k * ring_bytes :][:ring_bytes] for k in range(num_workers)]
    rings = [TrainerRings(part, envs, bell, k) for k, part in enumerate(parts)]
    channels: list[socket.socket] = []
    pids: list[int] = []
    for k, part in enumerate(parts):
        ours, theirs = socket.socketpair()
        channels.append(ours)
        pid = os.fork()
        if pid == 0:
            _work_and_exit(memory[:bell_bytes], num_workers, k, part, envs, theirs, channels)
        pids.append(pid)
        theirs.close()
    draw, number = random.Random(0), 0
    try:
        for _ in range(rounds):
            sent: list[list[int]] = []
            for k in range(num_workers):
                count = draw.randint(0, envs)
                sent.append([entry(number + n, n, Operation.STEP) for n in range(count)])
                if count and rings[k].request(np.array(sent[k], np.int64)):
                    channels[k].send(b"!")
            number += envs
            found: list[list[int]] = [[] for _ in sent]
            while left := sum(map(len, sent)) - sum(map(len, found)):
                wanted = draw.randint(1, left)
                bell.arm(bell.read[-1] + wanted, at_last=draw.random() < 0.7)
                if bell.unread() < wanted:
                    _any_bell(channels)
                for k in bell.with_news():
                    found[k] += rings[k].reports().tolist()
            assert found == sent
    finally:
        for ours in channels:
            ours.close()
        ended = [os.waitpid(pid, 0)[1] for pid in pids]
    assert ended == [0] * num_workers


def _any_bell(channels: list[socket.socket]) -> None:
    """Sleep until a worker rings, and read its bells."""
    readable: list[Any] = select.select(channels, [], [])[0]
    for channel in readable:
        channel.recv(1 << 16)
