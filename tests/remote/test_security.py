"""Only clients with keys are admitted, and other peers do no harm."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import shutil
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zmq
from kit.counting import ClientThread, CountingEnv, look, served
from patience import HANG
from remote.random_spaces import mutation
from zmq.utils.monitor import recv_monitor_message

from rlightning_aio import ConfigError, sync
from rlightning_aio._core.hosts.env_server.settings import server_settings
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import StartFailed
from rlightning_aio.protocol.net.wire import VERSION, ClientHello, Writer
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.remote import client as client_module
from rlightning_aio.remote.keys import make_keys, read_client_keys

if TYPE_CHECKING:
    from collections.abc import Callable


def entry(**env_kwargs: Any) -> dict[str, Any]:
    return served(**{"clients": ["arm"], **env_kwargs})


# Keys


def test_keys_can_be_added_later_and_are_never_overwritten(tmp_path: Path) -> None:
    """The server keeps its own key, so earlier clients still work."""
    (arm,) = make_keys(tmp_path, ["arm"])
    (leg,) = make_keys(tmp_path, ["leg"])
    assert read_client_keys(arm).server == read_client_keys(leg).server
    with pytest.raises(ConfigError, match="exists; remove it to make new keys for 'arm'"):
        make_keys(tmp_path, ["head", "arm"])
    assert not (tmp_path / "head").exists()


@pytest.mark.parametrize("name", ["", "../arm", "a b", "server", ".arm", "a/b"])
def test_a_name_that_cannot_be_a_files_is_refused(tmp_path: Path, name: str) -> None:
    """Nothing is written outside the directory, or over the server's keys."""
    with pytest.raises(ConfigError, match="can't name a client's keys"):
        make_keys(tmp_path, [name])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda d: (d / "client.key_secret").unlink(), "can't read the key .*client.key_secret"),
        (lambda d: (d / "server.key").write_text("x"), "server.key has no line public-key"),
        (
            lambda d: shutil.copy(d / "client.key", d / "client.key_secret"),
            "client.key_secret has no line secret-key",
        ),
    ],
)
def test_keys_that_cannot_be_read_are_named(
    tmp_path: Path, spoil: Callable[[Path], Any], says: str
) -> None:
    """The message has the file and the command that makes keys."""
    (arm,) = make_keys(tmp_path, ["arm"])
    spoil(arm)
    with pytest.raises(ConfigError, match=says):
        RemoteEnvClient(CountingEnv(), "127.0.0.1", 1, keys=arm)


def test_a_server_whose_keys_are_missing_is_not_built(tmp_path: Path) -> None:
    """Before anything listens."""
    with pytest.raises(ConfigError, match=r"can't read the key .*server.key_secret"):
        sync.build_env_group(entry(keys=str(tmp_path)))


def refused_keys(kind: str, tmp_path: Path) -> Path | None:
    """Return keys that must be refused, each wrong in its own way."""
    if kind == "no key":
        return None
    (other,) = make_keys(tmp_path / "elsewhere", ["mallory"])
    if kind == "the key of another server":
        return other
    # Knows the right server, but is not on its list.
    shutil.copy(tmp_path / "keys" / "arm" / "server.key", other / "server.key")
    if kind == "a key off the list":
        return other
    # Presents another client's public key without its secret.
    own = (other / "client.key_secret").read_text().splitlines()
    stolen = (tmp_path / "keys" / "arm" / "client.key").read_text().splitlines()
    own[2] = stolen[2]
    (other / "client.key_secret").write_text("\n".join(own) + "\n")
    return other


@pytest.mark.parametrize(
    "kind", ["no key", "the key of another server", "a key off the list", "a stolen public key"]
)
def test_a_client_without_the_right_key_is_not_admitted(kind: str, tmp_path: Path) -> None:
    """A client with the right key is served meanwhile."""
    (arm,) = make_keys(tmp_path / "keys", ["arm"])
    wrong = refused_keys(kind, tmp_path)
    errors: list[BaseException] = []

    def try_to_get_in() -> None:
        with RemoteEnvClient(CountingEnv(), "127.0.0.1", port, keys=wrong, name="mallory") as peer:
            try:
                peer.connect(timeout=0.5)
            except TimeoutError as error:
                errors.append(error)

    with sync.build_env_group(entry(keys=str(tmp_path / "keys" / "server"))) as group:
        port = int(group["robots-0"].address.rpartition(":")[2])
        friend = ClientThread(group["robots-0"].address, "arm", keys=arm)
        batch, _ = group.reset()
        thread = threading.Thread(target=try_to_get_in)
        thread.start()
        while thread.is_alive() or friend.env.steps <= 10:
            group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
            batch, _ = group.collect_async(deadline=HANG)
        thread.join()
        assert group["robots-0"].clients == {"robots-0/arm": "arm"}
        group.close()
        friend.join()
    (error,) = errors
    assert "did not let 'mallory' in within 0.5 s" in str(error)
    assert friend.env.steps > 10


def refused(address: str, keys: Path) -> str:
    """Return the error of a client that dials in with `keys` and is refused."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    with RemoteEnvClient(CountingEnv(), host, int(port), keys=keys, name="again") as client:
        while client.state in {"not connected", "asking to be let in"}:  # No failure so far.
            with pytest.raises(TimeoutError):
                client.connect(timeout=0.5)
        return client.state


@pytest.mark.parametrize("kind", ["no keys", "keys of another server", "keys where none are"])
def test_a_client_with_other_keys_is_logged_once_on_both_sides(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its handshakes fail before it has proved anything, one after the other."""
    events: list[int] = []

    def note(monitor: Any, flags: int) -> Any:
        event = recv_monitor_message(monitor, flags)
        events.append(event["event"])
        return event

    monkeypatch.setattr(client_module, "_SECONDS_BETWEEN_ATTEMPTS", (0.05, 0.8))
    monkeypatch.setattr(client_module, "recv_monitor_message", note)
    make_keys(tmp_path / "ours", ["arm"])
    make_keys(tmp_path / "theirs", ["arm"])
    server = {} if kind == "keys where none are" else {"keys": str(tmp_path / "ours" / "server")}
    client_keys = None if kind == "no keys" else tmp_path / "theirs" / "arm"
    caplog.set_level(logging.INFO, "rlightning_aio.remote")
    with sync.build_env_group(entry(**server)) as group:
        port = int(group["robots-0"].address.rpartition(":")[2])
        with RemoteEnvClient(
            CountingEnv(), "127.0.0.1", port, keys=client_keys, name="arm"
        ) as remote:
            while events.count(zmq.EVENT_CONNECTED) < 5 or "robots-0: " not in caplog.text:
                with pytest.raises(TimeoutError):
                    remote.connect(0.05)
                look(group)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == len(set(lines)) <= 3
    (line,) = [line for line in lines if line.startswith("robots-0: ")]
    assert "the other end has other keys than these, or none" in line
    assert any(line.startswith("arm: not connected (") for line in lines)


def test_a_key_that_is_overwritten_in_place_is_no_longer_admitted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A file whose name is not text keeps no other client out."""
    arm, leg = make_keys(tmp_path, ["arm", "leg"])
    listed = tmp_path / "server" / "clients"
    Path(os.fsdecode(os.fsencode(listed) + b"/\xff\x1b.key")).write_text("x")
    errors: list[str] = []
    kwargs = {"clients": ["arm", "leg"], "keys": str(tmp_path / "server")}
    with sync.build_env_group(entry(**kwargs)) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm", keys=arm)
        batch, _ = group.reset(env_ids=["robots-0/arm"])
        with (listed / "arm.key").open("r+") as file:
            file.write((listed / "leg.key").read_text())
        thread = threading.Thread(target=lambda: errors.append(refused(address, arm)))
        thread.start()
        while thread.is_alive():
            group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
            batch, _ = group.collect_async(deadline=HANG)
        thread.join()
        another = ClientThread(address, "leg", keys=leg)
        while len(group["robots-0"].clients) < 2:
            group.step_async(batch.respond(action=np.zeros((len(batch), 2), np.float32)))
            batch, _ = group.collect_async(deadline=HANG)
        group.close()
        friend.join()
        another.join()
    assert "the server does not know this client's key" in errors[0]
    assert caplog.text.count("\\udcff\\x1b.key has no line public-key") == 1


# Addresses and settings


@pytest.mark.parametrize("host", ["0.0.0.0", "*", "192.168.1.5", "::", "eth0"])
def test_a_public_address_needs_keys_or_insecure(host: str, tmp_path: Path) -> None:
    """Without either, the group isn't built."""

    def settings(**env_kwargs: Any) -> Any:
        kwargs = {"host": host, **env_kwargs}
        return server_settings(EnvConfig(name="r", backend="env_server", env_kwargs=kwargs))

    with pytest.raises(ConfigError, match=r"env_kwargs\.host.*can be reached from other machines"):
        settings()
    assert settings(insecure=True).host == host
    make_keys(tmp_path, [])
    assert settings(keys=str(tmp_path / "server")).host == host


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.9.9.9", "::1"])
def test_loopback_needs_neither(host: str) -> None:
    """Only this machine can reach it."""
    config = EnvConfig(name="r", backend="env_server", env_kwargs={"host": host})
    assert server_settings(config).host == host


@pytest.mark.parametrize(
    ("env_kwargs", "says"),
    [
        ({"prot": 1}, "env_kwargs.prot: unknown field; did you mean 'port'"),
        ({"prot": 1, "port": 70000}, "port: .*65535, got 70000\n.*prot: .*'port'"),
        ({"heartbeat": 0}, "env_kwargs.heartbeat"),
        ({"clients": 0}, "env_kwargs.clients"),
        ({"connect_timeout": "soon"}, "env_kwargs.connect_timeout"),
    ],
)
def test_a_wrong_setting_is_named_with_its_entry(env_kwargs: dict[str, Any], says: str) -> None:
    """Like every other field of a configuration."""
    with pytest.raises(ConfigError, match=f"(?s)'robots'.*{says}"):
        sync.build_env_group(entry(**env_kwargs))


def test_zmq_port_is_accepted() -> None:
    """It is the name of the port in RLightning."""
    config = EnvConfig(name="r", backend="env_server", env_kwargs={"zmq_port": 5})
    assert server_settings(config).port == 5


def test_a_port_that_is_taken_fails_the_start() -> None:
    """With a message that says what to change, and nothing left running."""
    with sync.build_env_group(entry()) as group:
        port = int(group["robots-0"].address.rpartition(":")[2])
        with pytest.raises(StartFailed, match=f"can't listen on 127.0.0.1:{port}.*in use"):
            sync.build_env_group(entry(port=port)).init()


# Unauthenticated peers with raw sockets


class Bomb:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (os.mkdir, (self.path,))


def say(peer: zmq.Socket[bytes], parts: list[bytes]) -> None:
    """Send a message, unless the connection was cut off and its queue is full."""
    with contextlib.suppress(zmq.Again):
        peer.send_multipart(parts, zmq.NOBLOCK)


def test_nonsense_and_pickles_of_unauthenticated_peers_do_no_harm(tmp_path: Path) -> None:
    """Raw messages, whole and corrupted, while a client is served."""
    rng = np.random.default_rng(0)
    bomb = pickle.dumps(Bomb(str(tmp_path / "exploded")))
    hello = Writer().write(
        ClientHello(version=VERSION, name="x", observation_space={}, action_space={})
    )
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
            peer.linger = 0
            peer.connect(address)
            for k in range(300):
                for parts in ([bomb], [b"", bomb], [hello[0], bomb], mutation(rng)(hello)):
                    if parts:
                        say(peer, parts)
                if k % 10 == 0:
                    group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
                    batch, _ = group.collect_async(deadline=HANG)
        assert group["robots-0"].clients == {"robots-0/arm": "arm"}
        group.close()
        friend.join()
    assert not (tmp_path / "exploded").exists()
    pickle.loads(bomb)
    assert (tmp_path / "exploded").exists(), "the bomb must be a real one"


def test_a_frame_beyond_the_limit_is_not_read() -> None:
    """Its sender is cut off before memory is spent on it."""
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
            peer.linger = 0
            monitor = peer.get_monitor_socket(zmq.EVENT_DISCONNECTED)
            peer.connect(address)
            peer.send(bytes((64 << 20) + 1))
            while not monitor.poll(0):
                group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
                batch, _ = group.collect_async(deadline=HANG)
            peer.disable_monitor()
            monitor.close()
        group.close()
        friend.join()


def test_a_client_survives_a_server_that_sends_nonsense(monkeypatch: pytest.MonkeyPatch) -> None:
    """It hangs up at the first malformed message, and dials again."""
    monkeypatch.setattr(client_module, "_SECONDS_BETWEEN_ATTEMPTS", (0.01, 0.01))
    rng = np.random.default_rng(1)
    done = threading.Event()
    hellos = 0

    def talk_nonsense() -> None:
        nonlocal hellos
        while not done.is_set():
            if router.poll(50):
                route, *parts = router.recv_multipart()
                hellos += 1
                for _ in range(50):
                    router.send_multipart([route, *mutation(rng)(parts)])

    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        port = router.bind_to_random_port("tcp://127.0.0.1")
        thread = threading.Thread(target=talk_nonsense)
        thread.start()
        env = CountingEnv()
        with RemoteEnvClient(env, "127.0.0.1", port, name="arm") as client:
            while hellos <= 20:
                with pytest.raises(TimeoutError):
                    client.connect(timeout=0.05)
            assert "a message of the server is malformed" in client.state
        done.set()
        thread.join()
    assert env.closed
    assert env.steps == env.resets == 0


def test_a_client_without_a_server_says_so() -> None:
    """The message has the address and the reason."""
    with (
        RemoteEnvClient(CountingEnv(), "127.0.0.1", 1, name="arm") as client,
        pytest.raises(
            TimeoutError, match=r"tcp://127.0.0.1:1 did not let 'arm' in.*no server answers"
        ),
    ):
        client.connect(timeout=2.0)
