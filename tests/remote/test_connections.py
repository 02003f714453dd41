"""Connections that come, break and say nothing useful."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Any

import numpy as np
import pytest
import zmq
from kit.counting import ClientThread, CountingEnv, look, served
from patience import HANG

from rlightning_aio import sync
from rlightning_aio.protocol.net.wire import Bye, Reset, Welcome, Writer
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.remote import client as client_module

ENTRY = served(clients=["arm", "greedy"], heartbeat=60.0)


def dial(address: str, count: int) -> list[socket.socket]:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    made = [socket.socket() for _ in range(count)]
    for one in made:
        one.setblocking(False)
        one.connect_ex((host, int(port)))
    return made


def welcomed(client: Any, server: Any, *then: Any) -> None:
    """Let a client in at a socket, and send it further messages."""
    while b"hello" not in (parts := server.recv_multipart() if server.poll(0) else [b"", b""])[1]:
        client._wait(0.0)
    for message in (Welcome(env_id="robots-0/arm", heartbeat=HANG), *then):
        server.send_multipart([parts[0], *Writer().write(message)])


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
        batch, _ = group.reset(env_ids=["robots-0/arm"])
        group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
        assert begun.wait(HANG)
        server: Any = group["robots-0"]._server
        listener = server.listener
        read_events = listener._read_events

        def read_late() -> None:
            monkeypatch.undo()
            env.finished = True
            gate.set()
            friend.join()
            assert listener._monitor.poll(1000 * HANG)
            read_events()

        monkeypatch.setattr(listener, "_read_events", read_late)
        listener.on_readable()
        batch, _ = group.collect_async(deadline=HANG)
    assert batch.observation.tolist() == [[0, -1, 1]]
    assert "client_lost" not in batch.values()[0].info


@pytest.mark.parametrize("hardware", [True, False])
def test_a_goodbye_during_a_step_is_read(hardware: bool, caplog: pytest.LogCaptureFixture) -> None:
    """The connection has ended before the client looks at it again, or its hardware is stopped."""
    begun, gate, stopped = threading.Event(), threading.Event(), threading.Event()

    def on_step() -> None:
        begun.set()
        if hardware:
            assert stopped.wait(HANG)
        else:
            assert gate.wait(HANG)
            assert friend.client._monitor.poll(1000 * HANG)

    env: Any = CountingEnv(on_step=on_step)
    env.stop = stopped.set
    with sync.build_env_group(ENTRY) as group:
        friend = ClientThread(group["robots-0"].address, "arm", env, hardware=hardware)
        batch, _ = group.reset(env_ids=["robots-0/arm"])
        group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
        assert begun.wait(HANG)
        group.close()
        gate.set()
        friend.join()
    cause = "the server ended the session: the trainer closed its group"
    assert [m for m in caplog.messages if "session" in m] == [f"arm: session over: {cause}"]
    assert env.disconnects == 1


def test_all_that_came_before_the_end_of_a_connection_is_read(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A client that was suspended finds its welcome, a request, a goodbye and the end at once.

    ``run`` asks the env then whether it is finished, and doesn't wait for another session.
    """
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        port = server.bind_to_random_port("tcp://127.0.0.1")
        env: Any = CountingEnv()
        with RemoteEnvClient(env, "127.0.0.1", port, name="arm", hardware=False) as client:
            welcomed(client, server, Reset(number=1), Bye(reason="enough"))
            server.close(linger=int(1000 * HANG))
            assert client._monitor.poll(1000 * HANG)
            client.run()
            assert caplog.messages[-1] == "arm: session over: the server ended the session: enough"
            assert client._dealer is None
            assert (env.disconnects, env.resets, client.num_sessions) == (1, 0, 1)


def test_a_client_that_runs_again_executes_nothing_of_the_session_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such as the request that it had read when Ctrl-C ended the first run; nor does it wait for
    that connection's end before it dials again.
    """
    monkeypatch.setattr(client_module, "_ATTEMPT_SECONDS", 10 * HANG)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        port = server.bind_to_random_port("tcp://127.0.0.1")
        env: Any = CountingEnv()
        with RemoteEnvClient(env, "127.0.0.1", port, name="arm", hardware=False) as client:

            def struck() -> None:
                if client._request is not None:
                    raise KeyboardInterrupt

            welcomed(client, server, Reset(number=1))
            monkeypatch.setattr(client, "_log_state", struck)
            with pytest.raises(KeyboardInterrupt):
                client.run()
            monkeypatch.setattr(client, "_log_state", lambda: None)
            welcomed(client, server, Bye(reason="enough"))
            client.run()
        assert env.resets == 0


@pytest.mark.parametrize(
    "greeting", [b"\x01\x00", b"\xff" + bytes(7) + b"\x01\x7f\x01\x05\x00\x00"]
)
def test_protocols_before_zmtp_3_are_turned_away_at_their_greeting(greeting: bytes) -> None:
    """A greeting that arrives while the socket closes would end the process (libzmq assertion)."""
    with sync.build_env_group(ENTRY) as group:
        listener = group["robots-0"]._server.listener
        (peer,) = dial(group["robots-0"].address, 1)
        with peer:
            peer.settimeout(HANG)
            peer.sendall(greeting + 5 * b"\x03\x00no")
            with contextlib.suppress(ConnectionResetError):
                while peer.recv(4096):
                    pass
        look(group)
        assert not listener._open
