"""Useless connections take neither descriptors nor time from useful ones."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import pytest
import zmq
from kit.counting import ClientThread, CountingEnv
from patience import HANG

from rlightning_aio import sync
from rlightning_aio._core.hosts.env_server import (
    authenticator,
    connection_limiter,
    listener,
    rate_limiter,
)
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.net.space_description import describe
from rlightning_aio.protocol.net.wire import MAX_PARTS, VERSION, Bye, ClientHello, Writer
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.remote.keys import make_keys

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
    """While the trainer is away. When it is back, it cuts off all but its clients."""
    monkeypatch.setattr(connection_limiter, "_MAX_CONNECTIONS", 20)
    # However slowly the last ones come, ZMQ must not give up the first ones.
    monkeypatch.setattr(authenticator, "HANDSHAKE_SECONDS", HANG)
    with sync.build_env_group(ENTRY) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        before = descriptors()
        peers: list[socket.socket] = []
        while len(peers) < 500:
            # Few enough for the queue of connections that wait to be accepted.
            peers += dial(address, 50)
            while descriptors() - before < 2 * len(peers):
                pass  # The trainer reads no events of ZMQ.
        peers += dial(address, 1000)
        assert descriptors() - before - 1500 <= connection_limiter._MAX_UNREAD_EVENTS + 20
        while descriptors() - before - 1500 > 20 or descriptors() < before + 1500:
            batch = step(group, batch)
        another = ClientThread(address, "leg")
        while len(group["robots-0"].clients) < 2:
            batch = step(group, batch)
        for one in peers:
            one.close()
        assert friend.env.disconnects == 0
        group.close()
        friend.join()
        another.join()


@contextlib.contextmanager
def with_a_client() -> Iterator[tuple[Any, Any, ClientThread, Any]]:
    """Yield a group, its listener, its only client, and the first results."""
    with sync.build_env_group(ENTRY) as group:
        friend = ClientThread(group["robots-0"].address, "arm")
        batch, _ = group.reset()
        yield group, group["robots-0"]._server._listener, friend, batch
        group.close()
        friend.join()


def test_a_result_that_comes_with_the_end_of_its_connection_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The client answers and leaves after the server has found no message, and before it looks at
    its connections.
    """
    begun, gate = threading.Event(), threading.Event()

    def on_step() -> None:
        begun.set()
        gate.wait(HANG)

    env = CountingEnv(on_step=on_step)
    with sync.build_env_group(ENTRY) as group:
        friend = ClientThread(group["robots-0"].address, "arm", env)
        batch, _ = group.reset()
        group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
        assert begun.wait(HANG)
        server: Any = group["robots-0"]._server
        connections = server._listener.connections
        update = connections.update

        def update_late(now: float) -> bool:
            monkeypatch.undo()
            env.finished = True
            gate.set()
            friend.join()
            assert connections._events.poll(1000 * HANG)
            return update(now)

        monkeypatch.setattr(connections, "update", update_late)
        server.tick(time.monotonic())
        batch, _ = group.collect_async(deadline=HANG)
    assert batch.observation.tolist() == [[0, -1, 1]]
    assert "client_lost" not in batch.values()[0].info


def step_until_one_is_cut_off(group: Any, listener: Any, batch: Any) -> None:
    """Then step for a while longer, in which further messages of the peer could arrive."""
    while not listener.connections.num_cut:
        batch = step(group, batch)
    for _ in range(50):
        batch = step(group, batch)


def test_a_message_of_too_many_parts_is_dropped_and_its_sender_cut_off() -> None:
    """It is read in small portions and discarded."""
    with with_a_client() as (group, listener, _, batch):
        with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
            peer.linger = 0
            peer.connect(group["robots-0"].address)
            peer.send_multipart([b""] * 20 * MAX_PARTS)
            step_until_one_is_cut_off(group, listener, batch)
        assert listener._sessions.num_malformed == 1
        assert group["robots-0"].clients == ["robots-0/arm"]


@pytest.mark.parametrize(
    "greeting", [b"\x01\x00", b"\xff" + bytes(7) + b"\x01\x7f\x01\x05\x00\x00"]
)
def test_protocols_before_zmtp_3_are_turned_away_at_their_greeting(greeting: bytes) -> None:
    """A greeting that arrives while the socket closes would end the process (libzmq assertion)."""
    with sync.build_env_group(ENTRY) as group:
        listener = group["robots-0"]._server._listener
        (peer,) = dial(group["robots-0"].address, 1)
        with peer:
            peer.settimeout(HANG)
            peer.sendall(greeting + 5 * b"\x03\x00no")
            with contextlib.suppress(ConnectionResetError):
                while peer.recv(4096):
                    pass
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=0.01)
        assert listener.connections.num_wasted == listener.connections.num_dropped == 0


@pytest.mark.parametrize(
    ("said", "most"),
    [(b"nonsense", 1), (Writer().write(Bye())[0], connection_limiter._MAX_WASTED + 1)],
)
def test_a_peer_that_sends_nothing_useful_is_cut_off(said: bytes, most: int) -> None:
    """At once after nonsense, and its further messages are not read; a client may be silent."""
    with with_a_client() as (group, listener, friend, batch):
        with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
            peer.linger = 0
            peer.set(zmq.RECONNECT_IVL, -1)
            peer.connect(group["robots-0"].address)
            for _ in range(1000):
                peer.send(said)
            step_until_one_is_cut_off(group, listener, batch)
        assert listener.connections.num_wasted == most
        assert friend.env.disconnects == 0


def hello() -> list[bytes]:
    """Return the hello of a client that never sends a result, of the kind of `CountingEnv`."""
    env = CountingEnv()
    observation_space = describe(env.get_observation_space(), "observation")
    action_space = describe(env.get_action_space(), "action")
    return Writer().write(
        ClientHello(
            version=VERSION,
            name="greedy",
            observation_space=observation_space,
            action_space=action_space,
        )
    )


def test_a_client_that_keeps_opening_connections_keeps_only_the_first_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its other connections make room, and no other client is cut off."""
    monkeypatch.setattr(connection_limiter, "_MAX_CONNECTIONS", 20)
    with with_a_client() as (group, listener, friend, first):
        batch = first
        with zmq.Context() as context, contextlib.ExitStack() as held:
            for _ in range(40):
                greedy = held.enter_context(context.socket(zmq.DEALER))
                greedy.linger = 0
                greedy.set(zmq.RECONNECT_IVL, -1)
                greedy.connect(group["robots-0"].address)
                greedy.send_multipart(hello())
                while not greedy.poll(0):
                    batch = step(group, batch)
                assert len(listener.connections._open) <= 20
            assert len(listener._sessions.routes()) == 2
        assert friend.env.disconnects == 0


@pytest.mark.parametrize("goodbye", [True, False])
def test_a_connection_that_ends_ends_its_session_at_once(goodbye: bool) -> None:
    """What it sent before counts, and its client may come back under its name."""
    with with_a_client() as (group, listener, _, first), zmq.Context() as context:
        batch = first
        for _ in range(3):
            with context.socket(zmq.DEALER) as peer:
                peer.linger = 0
                peer.connect(group["robots-0"].address)
                peer.send_multipart(hello())
                while not peer.poll(0):
                    batch = step(group, batch)
                assert msgspec.msgpack.decode(peer.recv_multipart()[0])["type"] == "welcome"
                if goodbye:
                    peer.linger = int(1000 * HANG)
                    peer.send_multipart(Writer().write(Bye(reason="enough")))
            while len(listener._sessions.routes()) == 2:
                batch = step(group, batch)


# The budget of unauthenticated peers

SHORT = {**ENTRY, "env_kwargs": {"heartbeat": 5.0, "connect_timeout": HANG}}
"""A client that doesn't hear the server's goodbye ends within that time."""


def spend_everything(address: str, group: Any, listener: Any) -> None:
    """Send nonsense over new connections until no peer is admitted any longer."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.linger = 0
        peer.set(zmq.RECONNECT_IVL, 1)
        peer.connect(address)
        while not listener._authenticator.deadline(time.monotonic()):
            with contextlib.suppress(zmq.Again):
                peer.send(b"nonsense", zmq.NOBLOCK)
            with contextlib.suppress(TimeoutError):
                group.collect_async(deadline=0.01)


def try_to_connect(address: str, errors: list[str]) -> None:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    with RemoteEnvClient(CountingEnv(), host, int(port), name="late") as client:
        try:
            client.connect(timeout=1.0)
        except TimeoutError as error:
            errors.append(str(error))


def test_unauthenticated_peers_wait_when_their_budget_is_used_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Clients have used none of it and are still served."""
    monkeypatch.setattr(listener, "MAX_SAVED", 2 * rate_limiter.CONNECTION_COST)
    monkeypatch.setattr(listener, "PEERS_SHARE", 1e-9)
    with sync.build_env_group(SHORT) as group:
        address = group["robots-0"].address
        friends = [ClientThread(address, name) for name in ("arm", "leg", "head")]
        batch, _ = group.reset()
        while len(group["robots-0"].clients) < 3:
            batch = step(group, batch)
        spend_everything(address, group, group["robots-0"]._server._listener)
        errors: list[str] = []
        late = threading.Thread(target=try_to_connect, args=(address, errors))
        late.start()
        while late.is_alive():
            batch = step(group, batch)
        assert len(errors) == 1
        group.close()
        for friend in friends:
            friend.join()


def test_clients_with_keys_use_none_of_the_budget_of_unauthenticated_peers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The budget is enough for one peer; three clients are admitted."""
    monkeypatch.setattr(listener, "MAX_SAVED", rate_limiter.CONNECTION_COST)
    monkeypatch.setattr(listener, "PEERS_SHARE", 1e-9)
    keys = make_keys(tmp_path, ["arm", "leg", "head"])
    kwargs = {**SHORT["env_kwargs"], "keys": str(tmp_path / "server"), "min_clients": 3}
    with sync.build_env_group({**SHORT, "env_kwargs": kwargs}) as group:
        friends = [ClientThread(group["robots-0"].address, key.name, keys=key) for key in keys]
        group.reset()
        group.close()
        for friend in friends:
            friend.join()


@pytest.mark.parametrize("looks", [0.0, 1.0])
def test_clients_are_admitted_although_many_connections_come_and_go(
    monkeypatch: pytest.MonkeyPatch, looks: float
) -> None:
    """New connections are then processed together, at times that the trainer sets itself."""
    monkeypatch.setattr(listener, "_MAX_CONSECUTIVE_UPDATES", looks)
    with sync.build_env_group(SHORT) as group:
        friends = [ClientThread(group["robots-0"].address, str(k)) for k in range(3)]
        while len(group["robots-0"].clients) < 3:
            group.reset()
        group.close()
        for friend in friends:
            friend.join()


@pytest.mark.parametrize(
    "given", [("127.0.0.1",), ("tcp://127.0.0.1",), ("tcp://127.0.0.1:5555", 5555), ("ipc://x", 1)]
)
def test_an_address_that_is_not_whole_or_given_twice_is_refused(given: Any) -> None:
    with pytest.raises(ConfigError, match=r"give a host and a port, or tcp://127.0.0.1:5555"):
        RemoteEnvClient(CountingEnv(), *given)
