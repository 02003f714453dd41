"""Messages between a trainer and its fork server arrive whole, and neither waits for the other."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from patience import HANG

import rlightning_aio
from rlightning_aio._core.hosts.messages import WorkerPlace
from rlightning_aio._core.hosts.process.fork_messages import (
    Fork,
    MessageSocket,
    NotForked,
    Preload,
    Ready,
)
from rlightning_aio._core.hosts.process.fork_server import BOOTSTRAP

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio._core.hosts.process.fork_messages import Received

Pair = tuple[MessageSocket, MessageSocket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pair = MessageSocket(ends[0]), MessageSocket(ends[1])
    yield pair
    for end in pair:
        end.close()


def next_message(end: MessageSocket) -> Received:
    """Wait for the next message."""
    while (received := end.receive()) is None:
        assert any(select.select([end], [end] if end.waiting else [], [], HANG))
        end.flush()
    return received


def test_messages_of_any_length_arrive_whole_with_their_descriptors(pair: Pair) -> None:
    """They may exceed a packet, and the buffer of the socket."""
    trainer, server = pair
    path = [f"/somewhere/{k}/" + "x" * 1000 for k in range(3000)]
    given, kept = socket.socketpair()
    reader, writer = os.pipe()
    server.send(Ready(None))
    trainer.send(Preload(path, ()))
    assert trainer.waiting
    trainer.send(Preload(path, ("with descriptors",)), given, (writer,))
    found = []
    while len(found) < 2:
        trainer.flush()
        received = server.receive()
        if received is not None:
            found.append(received)
    assert found[0] == (Preload(path, ()), [])
    preload, (channel, arena) = found[1]
    assert preload == Preload(path, ("with descriptors",))
    assert given.fileno() == -1, "it was closed"
    os.write(channel, b"by the channel")
    os.write(arena, b"by the arena")
    assert kept.recv(100) == b"by the channel"
    assert os.read(reader, 100) == b"by the arena"
    assert not os.get_inheritable(channel)
    assert next_message(trainer) == (Ready(None), [])
    kept.close()
    for descriptor in (channel, arena, reader, writer):
        os.close(descriptor)


def test_last_messages_arrive_even_if_the_sender_left_some_unread(pair: Pair) -> None:
    """The kernel reports the connection reset before it returns the messages."""
    trainer, server = pair
    trainer.send(Preload(None, ()))
    server.send(Ready("why"))
    server.close()
    assert trainer.receive() == (Ready("why"), [])
    with pytest.raises(EOFError):
        trainer.receive()
    given, kept = socket.socketpair()
    trainer.send(Preload(None, ()), given)
    assert not trainer.waiting
    assert given.fileno() == -1
    kept.close()


def test_waiting_descriptors_are_closed_with_the_socket(pair: Pair) -> None:
    """This includes the channel of an order that was never read."""
    trainer, _ = pair
    trainer.send(Preload(["x" * 2**20], ()))
    given, kept = socket.socketpair()
    trainer.send(Preload(None, ()), given)
    trainer.close()
    assert given.fileno() == -1
    kept.close()


def test_fork_server_serves_a_trainer_that_does_not_read() -> None:
    """Its messages wait, however many there are; then all of them arrive."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    package = str(Path(rlightning_aio.__file__).parent)
    numbers = [str(theirs.fileno()), str(os.getpid())]
    process = subprocess.Popen(
        [sys.executable, "-c", BOOTSTRAP, package, *numbers], pass_fds=[theirs.fileno()]
    )
    theirs.close()
    trainer = MessageSocket(ours)
    try:
        # A path may have any length.
        trainer.send(Preload([*sys.path, *("/nowhere/" + "x" * 250 for _ in range(1000))], ()))
        assert next_message(trainer).message == Ready(None)
        # Orders without a channel fail, so this needs no worker.
        count = 3000
        for host_id in range(count):
            trainer.send(Fork(WorkerPlace(host_id, 1, 0, 1, 0, 0)))
        while trainer.waiting:
            assert select.select([], [trainer], [], HANG)[1], "it reads no more"
            trainer.flush()
        for host_id in range(count):
            message = next_message(trainer).message
            assert isinstance(message, NotForked)
            assert message.host_id == host_id
            assert "descriptors didn't arrive" in message.why
    finally:
        trainer.close()
        process.wait(HANG)
