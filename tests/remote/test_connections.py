"""Connections that are of no use take neither descriptors nor time from those that are."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq
from patience import HANG
from remote.counting import ClientThread

from rlightning_aio import sync
from rlightning_aio.hosts import door
from rlightning_aio.protocol.net.wire import MAX_PARTS

if TYPE_CHECKING:
    import pytest

ENTRY: dict[str, Any] = {
    "name": "robots",
    "backend": "env_server",
    "env_kwargs": {"heartbeat": 60.0, "connect_timeout": HANG},
}


def descriptors() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def dial(address: str, count: int) -> list[socket.socket]:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    made = [socket.socket() for _ in range(count)]
    for one in made:
        one.setblocking(False)
        one.connect_ex((host, int(port)))
    return made


def step(group: Any, batch: Any) -> Any:
    group.step_async(batch.respond(action=np.zeros((len(batch), 2), np.float32)))
    return group.collect_async(deadline=HANG)[0]


def test_a_flood_of_connections_takes_a_bounded_number_of_descriptors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While the trainer is away; when it is back it cuts them off, but for its clients."""
    monkeypatch.setattr(door, "_MOST", 20)
    with sync.build_env_group(ENTRY) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        before = descriptors()
        strangers = dial(address, 1500)
        while descriptors() - before < 1500 + 500:
            pass  # Nobody reads what ZMQ tells.
        assert descriptors() - before - 1500 <= door._UNREAD_EVENTS + 20
        while descriptors() - before - 1500 > 20 or descriptors() < before + 1500:
            batch = step(group, batch)
        another = ClientThread(address, "leg")
        while len(group["robots-0"].clients) < 2:
            batch = step(group, batch)
        for one in strangers:
            one.close()
        assert friend.env.disconnects == 0
        group.close()
        friend.join()
        another.join()


def test_a_message_of_too_many_parts_is_dropped_and_its_sender_cut_off() -> None:
    """It is read a little at a time, and nothing is made of it."""
    with sync.build_env_group(ENTRY) as group:
        listener = group["robots-0"]._server[0]._listener
        friend = ClientThread(group["robots-0"].address, "arm")
        batch, _ = group.reset()
        with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
            stranger.linger = 0
            stranger.connect(group["robots-0"].address)
            stranger.send_multipart([b""] * 20 * MAX_PARTS)
            while not listener.num_cut:
                batch = step(group, batch)
            for _ in range(50):
                batch = step(group, batch)
        assert listener.malformed == 1
        assert group["robots-0"].clients == ["robots-0/arm"]
        group.close()
        friend.join()


def test_nonsense_in_the_oldest_protocol_of_zmq_is_dropped() -> None:
    """Of such messages ZMQ does not tell from which connection they are."""
    with sync.build_env_group(ENTRY) as group:
        listener = group["robots-0"]._server[0]._listener
        friend = ClientThread(group["robots-0"].address, "arm")
        batch, _ = group.reset()
        (stranger,) = dial(group["robots-0"].address, 1)
        with stranger:
            stranger.settimeout(HANG)
            # ZMTP 1.0: a nameless peer, then messages of two bytes.
            stranger.sendall(b"\x01\x00" + 5 * b"\x03\x00no")
            while listener.malformed < 5:
                batch = step(group, batch)
        assert group["robots-0"].clients == ["robots-0/arm"]
        group.close()
        friend.join()


def test_whoever_says_nothing_of_use_is_cut_off() -> None:
    """What it has said beyond that is not even read; a client may be silent or err."""
    with sync.build_env_group(ENTRY) as group:
        listener = group["robots-0"]._server[0]._listener
        friend = ClientThread(group["robots-0"].address, "arm")
        batch, _ = group.reset()
        with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
            stranger.linger = 0
            stranger.set(zmq.RECONNECT_IVL, -1)
            stranger.connect(group["robots-0"].address)
            for _ in range(1000):
                stranger.send(b"nonsense")
            while not listener.num_cut:
                batch = step(group, batch)
            for _ in range(50):
                batch = step(group, batch)
        assert listener.malformed == door._MOST_WASTED + 1
        assert friend.env.disconnects == 0
        group.close()
        friend.join()
