"""A trainer and its fork server hear each other whole, and neither ever waits for the other."""

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
from rlightning_aio.hosts.fork_messages import Exited, Fork, Hello, MessageSocket, Ready
from rlightning_aio.hosts.fork_server import BOOTSTRAP
from rlightning_aio.hosts.messages import WorkerPlace

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.hosts.fork_messages import Received

Pair = tuple[MessageSocket, MessageSocket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pair = MessageSocket(ends[0]), MessageSocket(ends[1])
    yield pair
    for end in pair:
        end.close()


def heard(end: MessageSocket) -> Received:
    """The next message, whatever time it takes."""
    while (received := end.receive()) is None:
        assert any(select.select([end], [end] if end.waiting else [], [], HANG))
        end.flush()
    return received


def test_messages_of_any_length_arrive_whole_and_with_their_descriptors(pair: Pair) -> None:
    """More than any packet takes, and more than the socket takes at once."""
    trainer, server = pair
    path = [f"/somewhere/{k}/" + "x" * 1000 for k in range(3000)]
    given, kept = socket.socketpair()
    reader, writer = os.pipe()
    server.send(Ready(None))
    trainer.send(Hello(path, ()))
    assert trainer.waiting
    trainer.send(Hello(path, ("with descriptors",)), given, (writer,))
    found = []
    while len(found) < 2:
        trainer.flush()
        received = server.receive()
        if received is not None:
            found.append(received)
    assert found[0] == (Hello(path, ()), [])
    hello, (channel, arena) = found[1]
    assert hello == Hello(path, ("with descriptors",))
    assert given.fileno() == -1, "it was given away"
    os.write(channel, b"by the channel")
    os.write(arena, b"by the arena")
    assert kept.recv(100) == b"by the channel"
    assert os.read(reader, 100) == b"by the arena"
    assert not os.get_inheritable(channel)
    assert heard(trainer) == (Ready(None), [])
    kept.close()
    for descriptor in (channel, arena, reader, writer):
        os.close(descriptor)


def test_neither_end_waits_for_one_that_reads_nothing(pair: Pair) -> None:
    """Both have more to say than fits, and say it all before they listen."""
    said = [Exited(k, 1, "x" * 9000) for k in range(1000)]
    for message in said:
        for end in pair:
            end.send(message)
    assert all(end.waiting for end in pair)
    rest = {end: list(reversed(said)) for end in pair}
    while any(rest.values()):
        for end, other in (pair, pair[::-1]):
            end.flush()
            while (received := other.receive()) is not None:
                assert received.message == rest[end].pop()


def test_last_words_are_heard_though_something_was_left_unread(pair: Pair) -> None:
    """The kernel tells of the second before it hands out the first."""
    trainer, server = pair
    trainer.send(Hello(None, ()))
    server.send(Ready("why"))
    server.close()
    assert trainer.receive() == (Ready("why"), [])
    with pytest.raises(EOFError):
        trainer.receive()
    given, kept = socket.socketpair()
    trainer.send(Hello(None, ()), given)
    assert not trainer.waiting
    assert given.fileno() == -1
    kept.close()


def test_what_waits_is_given_back_when_it_can_not_be_sent(pair: Pair) -> None:
    """A channel whose order nobody has read is closed along with the socket."""
    trainer, _ = pair
    trainer.send(Hello(["x" * 2**20], ()))
    given, kept = socket.socketpair()
    trainer.send(Hello(None, ()), given)
    trainer.close()
    assert given.fileno() == -1
    kept.close()


def test_fork_server_obeys_a_trainer_that_does_not_listen() -> None:
    """What it has to tell waits in there, however much it is; then all of it is told."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    package = str(Path(rlightning_aio.__file__).parent)
    numbers = [str(theirs.fileno()), str(os.getpid())]
    process = subprocess.Popen(
        [sys.executable, "-c", BOOTSTRAP, package, *numbers], pass_fds=[theirs.fileno()]
    )
    theirs.close()
    trainer = MessageSocket(ours)
    try:
        # Nobody knows how long a path may be.
        trainer.send(Hello([*sys.path, *("/nowhere/" + "x" * 250 for _ in range(1000))], ()))
        assert heard(trainer).message == Ready(None)
        # Orders without a channel, which can't be followed; so no worker is needed for this.
        count = 3000
        for host_id in range(count):
            trainer.send(Fork(WorkerPlace(host_id, 1, 0, 1, 0, 0)))
        while trainer.waiting:
            assert select.select([], [trainer], [], HANG)[1], "it reads no more"
            trainer.flush()
        for host_id in range(count):
            message = heard(trainer).message
            assert isinstance(message, Exited)
            assert message.host_id == host_id
            assert "no worker could be forked" in message.stderr_tail
    finally:
        trainer.close()
        process.wait(HANG)
