"""Connections that are of no use take neither descriptors nor time from those that are."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zmq
from patience import HANG
from remote.counting import ClientThread, CountingEnv

from rlightning_aio import sync
from rlightning_aio.hosts import allowance, door, gate, listener
from rlightning_aio.protocol.net.space_description import describe
from rlightning_aio.protocol.net.wire import MAX_PARTS, VERSION, Hello, Ping, Writer
from rlightning_aio.remote import RemoteEnvClient, make_keys

if TYPE_CHECKING:
    from collections.abc import Iterator

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
    # However slowly the last ones come, ZMQ is not to give the first ones up.
    monkeypatch.setattr(gate, "HANDSHAKE_SECONDS", HANG)
    with sync.build_env_group(ENTRY) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        before = descriptors()
        strangers: list[socket.socket] = []
        while len(strangers) < 500:
            # So few that all find room where connections wait to be accepted.
            strangers += dial(address, 50)
            while descriptors() - before < 2 * len(strangers):
                pass  # Nobody reads what ZMQ tells.
        strangers += dial(address, 1000)
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


@contextlib.contextmanager
def with_a_client() -> Iterator[tuple[Any, Any, ClientThread, Any]]:
    """A group, its listener, its only client, and the first results."""
    with sync.build_env_group(ENTRY) as group:
        friend = ClientThread(group["robots-0"].address, "arm")
        batch, _ = group.reset()
        yield group, group["robots-0"]._server[0]._listener, friend, batch
        group.close()
        friend.join()


def step_until_one_is_cut_off(group: Any, listener: Any, batch: Any) -> None:
    """And on for a while, in which what it has said beyond that could come in."""
    while not listener.door.num_cut:
        batch = step(group, batch)
    for _ in range(50):
        batch = step(group, batch)


def test_a_message_of_too_many_parts_is_dropped_and_its_sender_cut_off() -> None:
    """It is read a little at a time, and nothing is made of it."""
    with with_a_client() as (group, listener, _, batch):
        with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
            stranger.linger = 0
            stranger.connect(group["robots-0"].address)
            stranger.send_multipart([b""] * 20 * MAX_PARTS)
            step_until_one_is_cut_off(group, listener, batch)
        assert listener.malformed == 1
        assert group["robots-0"].clients == ["robots-0/arm"]


@pytest.mark.parametrize(
    "greeting", [b"\x01\x00", b"\xff" + bytes(7) + b"\x01\x7f\x01\x05\x00\x00"]
)
def test_protocols_before_zmtp_3_are_turned_away_at_their_greeting(greeting: bytes) -> None:
    """One that greets while the socket closes would end the process: an assertion of libzmq's."""
    with sync.build_env_group(ENTRY) as group:
        listener = group["robots-0"]._server[0]._listener
        (stranger,) = dial(group["robots-0"].address, 1)
        with stranger:
            stranger.settimeout(HANG)
            stranger.sendall(greeting + 5 * b"\x03\x00no")
            with contextlib.suppress(ConnectionResetError):
                while stranger.recv(4096):
                    pass
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=0.01)
        assert listener.door.num_wasted == listener.door.num_dropped == 0


def ping() -> bytes:
    return Writer().write(Ping(session=1))[0]


@pytest.mark.parametrize(("said", "most"), [(b"nonsense", 1), (ping(), door._MOST_WASTED + 1)])
def test_whoever_says_nothing_of_use_is_cut_off(said: bytes, most: int) -> None:
    """At once if it is nonsense, and what it has said beyond isn't read; a client may be silent."""
    with with_a_client() as (group, listener, friend, batch):
        with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
            stranger.linger = 0
            stranger.set(zmq.RECONNECT_IVL, -1)
            stranger.connect(group["robots-0"].address)
            for _ in range(1000):
                stranger.send(said)
            step_until_one_is_cut_off(group, listener, batch)
        assert listener.door.num_wasted == most
        assert friend.env.disconnects == 0


def hello() -> list[bytes]:
    """Of a client that never has a result, beside those of `CountingEnv`."""
    env = CountingEnv()
    observation_space = describe(env.get_observation_space(), "observation")
    action_space = describe(env.get_action_space(), "action")
    return Writer().write(
        Hello(
            version=VERSION,
            name="greedy",
            nonce=1,
            observation_space=observation_space,
            action_space=action_space,
        )
    )


def test_a_client_that_speaks_over_ever_new_connections_keeps_the_last_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The others make room, as if it had never been a client there; nobody else is cut off."""
    monkeypatch.setattr(door, "_MOST", 20)
    with with_a_client() as (group, listener, friend, first):
        batch, message = first, hello()
        with zmq.Context() as context, contextlib.ExitStack() as held:
            for _ in range(40):
                greedy = held.enter_context(context.socket(zmq.DEALER))
                greedy.linger = 0
                greedy.set(zmq.RECONNECT_IVL, -1)
                greedy.connect(group["robots-0"].address)
                greedy.send_multipart(message)
                while not greedy.poll(0):
                    batch = step(group, batch)
                (token,) = [
                    token
                    for token, session in listener._sessions._sessions.items()
                    if session.seat.name == "greedy"
                ]
                message = Writer().write(Ping(session=token))
                assert len(listener.door._open) <= 20
        assert friend.env.disconnects == 0


# What strangers may take

SHORT = {**ENTRY, "env_kwargs": {"heartbeat": 5.0, "connect_timeout": HANG}}
"""A client that doesn't hear the server's goodbye ends a quarter of that later."""


def spend_everything(address: str, group: Any, listener: Any) -> None:
    """Talk nonsense over ever new connections, until nobody is let in any more."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
        stranger.linger = 0
        stranger.set(zmq.RECONNECT_IVL, 1)
        stranger.connect(address)
        while not listener._gate.deadline(time.monotonic()):
            with contextlib.suppress(zmq.Again):
                stranger.send(b"nonsense", zmq.NOBLOCK)
            with contextlib.suppress(TimeoutError):
                group.collect_async(deadline=0.01)


def try_to_come_in(address: str, told: list[str]) -> None:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    with RemoteEnvClient(CountingEnv(), host, int(port), name="late") as client:
        try:
            client.connect(timeout=1.0)
        except TimeoutError as error:
            told.append(str(error))


def test_strangers_wait_when_they_have_taken_what_is_theirs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Who became a client has taken nothing of it, and is served on."""
    monkeypatch.setattr(listener, "SAVED", 2 * allowance.CONNECTION)
    monkeypatch.setattr(listener, "STRANGERS_SHARE", 1e-9)
    with sync.build_env_group(SHORT) as group:
        address = group["robots-0"].address
        friends = [ClientThread(address, name) for name in ("arm", "leg", "head")]
        batch, _ = group.reset()
        while len(group["robots-0"].clients) < 3:
            batch = step(group, batch)
        spend_everything(address, group, group["robots-0"]._server[0]._listener)
        told: list[str] = []
        late = threading.Thread(target=try_to_come_in, args=(address, told))
        late.start()
        while late.is_alive():
            batch = step(group, batch)
        assert len(told) == 1
        group.close()
        for friend in friends:
            friend.join()


def test_who_has_a_key_takes_nothing_of_what_strangers_may(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """There is enough for one stranger; three clients come in."""
    monkeypatch.setattr(listener, "SAVED", allowance.CONNECTION)
    monkeypatch.setattr(listener, "STRANGERS_SHARE", 1e-9)
    keys = make_keys(tmp_path, ["arm", "leg", "head"])
    kwargs = {**SHORT["env_kwargs"], "keys": str(tmp_path / "server"), "min_clients": 3}
    with sync.build_env_group({**SHORT, "env_kwargs": kwargs}) as group:
        friends = [ClientThread(group["robots-0"].address, key.name, keys=key) for key in keys]
        group.reset()
        group.close()
        for friend in friends:
            friend.join()


@pytest.mark.parametrize("looks", [0.0, 1.0])
def test_clients_come_in_though_so_many_come_and_go(
    monkeypatch: pytest.MonkeyPatch, looks: float
) -> None:
    """Those who come are looked at together then, without anybody else's waking the trainer."""
    monkeypatch.setattr(listener, "_LOOKS_IN_A_ROW", looks)
    with sync.build_env_group(SHORT) as group:
        friends = [ClientThread(group["robots-0"].address, str(k)) for k in range(3)]
        while len(group["robots-0"].clients) < 3:
            group.reset()
        group.close()
        for friend in friends:
            friend.join()
