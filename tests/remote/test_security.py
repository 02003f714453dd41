"""Who may come in, and what strangers can do: nothing."""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zmq
from patience import HANG
from remote.counting import ClientThread, CountingEnv
from remote.random_spaces import mutation

from rlightning_aio import ConfigError, sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import StartFailed
from rlightning_aio.hosts.listener import server_settings
from rlightning_aio.protocol.net.wire import Hello, Writer
from rlightning_aio.remote import RemoteEnvClient, make_keys
from rlightning_aio.remote.keys import read_client_keys, read_server_keys

if TYPE_CHECKING:
    from collections.abc import Callable


def entry(**env_kwargs: Any) -> dict[str, Any]:
    kwargs = {"heartbeat": 5.0, "connect_timeout": HANG, **env_kwargs}
    return {"name": "robots", "backend": "env_server", "env_kwargs": kwargs}


# Keys


def test_keygen_lays_out_a_directory_for_each_machine(tmp_path: Path) -> None:
    """Secrets are the owner's alone, and each side gets the other's public key."""
    arm, leg = make_keys(tmp_path, ["arm", "leg"])
    server = tmp_path / "server"
    assert (arm, leg) == (tmp_path / "arm", tmp_path / "leg")
    for secret in (server / "server.key_secret", arm / "client.key_secret"):
        assert secret.stat().st_mode & 0o777 == 0o600
    assert sorted(path.name for path in (server / "clients").iterdir()) == ["arm.key", "leg.key"]
    assert read_client_keys(arm).server == read_client_keys(leg).server
    assert read_client_keys(arm).secret != read_client_keys(leg).secret
    assert read_server_keys(server).secret != read_client_keys(arm).secret


def test_keys_can_be_added_later_and_are_never_overwritten(tmp_path: Path) -> None:
    """The server keeps its own key, so that clients which have it go on working."""
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


def test_keys_are_zeromq_certificates(tmp_path: Path) -> None:
    """ZeroMQ's own tools read them."""
    from zmq.auth import load_certificate

    (arm,) = make_keys(tmp_path, ["arm"])
    keys = read_client_keys(arm)
    assert load_certificate(arm / "client.key_secret") == (keys.public, keys.secret)


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


def stranger_keys(kind: str, tmp_path: Path) -> Path | None:
    """Keys that must not open the door, each wrong in its own way."""
    if kind == "no key":
        return None
    (other,) = make_keys(tmp_path / "elsewhere", ["mallory"])
    if kind == "the key of another server":
        return other
    # Knows the right server, but is not on its list.
    shutil.copy(tmp_path / "keys" / "arm" / "server.key", other / "server.key")
    if kind == "a key off the list":
        return other
    # Shows somebody else's public key without having the secret.
    own = (other / "client.key_secret").read_text().splitlines()
    stolen = (tmp_path / "keys" / "arm" / "client.key").read_text().splitlines()
    own[2] = stolen[2]
    (other / "client.key_secret").write_text("\n".join(own) + "\n")
    return other


@pytest.mark.parametrize(
    "kind", ["no key", "the key of another server", "a key off the list", "a stolen public key"]
)
def test_who_has_not_the_right_key_gets_nowhere(kind: str, tmp_path: Path) -> None:
    """And who has is served meanwhile."""
    (arm,) = make_keys(tmp_path / "keys", ["arm"])
    wrong = stranger_keys(kind, tmp_path)
    errors: list[BaseException] = []

    def try_to_get_in() -> None:
        with RemoteEnvClient(
            CountingEnv(), "127.0.0.1", port, keys=wrong, name="mallory"
        ) as stranger:
            try:
                stranger.connect(timeout=1.5)
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
        assert group["robots-0"].clients == ["robots-0/arm"]
        group.close()
        friend.join()
    (error,) = errors
    assert "did not let 'mallory' in within 1.5 s" in str(error)
    assert friend.env.steps > 10


def test_a_client_is_told_when_its_key_is_not_on_the_list(tmp_path: Path) -> None:
    """Its own message says what to look at; adding the key lets it in, without a restart."""
    (arm,) = make_keys(tmp_path, ["arm"])
    listed = tmp_path / "server" / "clients" / "arm.key"
    hidden = tmp_path / "arm.key"
    listed.rename(hidden)
    with sync.build_env_group(entry(keys=str(tmp_path / "server"))) as group:
        friend = ClientThread(group["robots-0"].address, "arm", keys=arm)
        while "the server does not know this client's key" not in friend.client.state:
            with pytest.raises(TimeoutError):
                # Nobody comes; the group only has to listen meanwhile.
                group.collect_async(deadline=0.1)
        hidden.rename(listed)
        batch, _ = group.reset()
        assert batch.values()[0].env_id == "robots-0/arm"
        group.close()
        friend.join()


def refused(address: str, keys: Path) -> str:
    """What a client is told that dials in with `keys` and isn't let in."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    with RemoteEnvClient(CountingEnv(), host, int(port), keys=keys, name="again") as client:
        while client.state in {"not connected", "asking to be let in"}:  # No trouble so far.
            with pytest.raises(TimeoutError):
                client.connect(timeout=0.5)
        return client.state


def test_a_key_that_is_overwritten_in_place_gets_in_no_more(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Nor does a file whose name is no text keep anybody else out."""
    arm, leg = make_keys(tmp_path, ["arm", "leg"])
    listed = tmp_path / "server" / "clients"
    Path(os.fsdecode(os.fsencode(listed) + b"/\xff\x1b.key")).write_text("x")
    told: list[str] = []
    with sync.build_env_group(entry(keys=str(tmp_path / "server"))) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm", keys=arm)
        batch, _ = group.reset()
        with (listed / "arm.key").open("r+") as file:
            file.write((listed / "leg.key").read_text())
        thread = threading.Thread(target=lambda: told.append(refused(address, arm)))
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
    assert "the server does not know this client's key" in told[0]
    warnings = [r.getMessage() for r in caplog.records if "can't be a client's" in r.getMessage()]
    assert len(warnings) == 1
    assert "\\udcff\\x1b.key" in warnings[0]


# Addresses and settings


@pytest.mark.parametrize("host", ["0.0.0.0", "*", "192.168.1.5", "::", "eth0"])
def test_a_public_address_needs_keys_or_an_explicit_word(host: str, tmp_path: Path) -> None:
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
    """It is this machine's own."""
    config = EnvConfig(name="r", backend="env_server", env_kwargs={"host": host})
    assert server_settings(config).host == host


@pytest.mark.parametrize(
    ("env_kwargs", "says"),
    [
        ({"prot": 1}, "env_kwargs.prot: unknown field; did you mean 'port'"),
        ({"port": 70000}, "env_kwargs.port: .*65535.*got 70000"),
        ({"heartbeat": 0}, "env_kwargs.heartbeat"),
        ({"min_clients": 0}, "env_kwargs.min_clients"),
        ({"connect_timeout": "soon"}, "env_kwargs.connect_timeout"),
    ],
)
def test_a_wrong_setting_is_named_with_its_entry(env_kwargs: dict[str, Any], says: str) -> None:
    """As every other field of a configuration is."""
    with pytest.raises(ConfigError, match=f"'robots'.*{says}"):
        sync.build_env_group(entry(**env_kwargs))


def test_zmq_port_is_understood() -> None:
    """It is what RLightning calls the port."""
    config = EnvConfig(name="r", backend="env_server", env_kwargs={"zmq_port": 5})
    assert server_settings(config).port == 5


def test_a_port_that_is_taken_fails_the_start() -> None:
    """With a message that says what to change, and nothing left running."""
    with sync.build_env_group(entry()) as group:
        port = int(group["robots-0"].address.rpartition(":")[2])
        with pytest.raises(StartFailed, match=f"can't listen on 127.0.0.1:{port}.*in use"):
            sync.build_env_group(entry(port=port)).init()


# Strangers with a socket of their own


class Bomb:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (os.mkdir, (self.path,))


def say(stranger: zmq.Socket[bytes], parts: list[bytes]) -> None:
    """Unless it is cut off and has said too much meanwhile."""
    with contextlib.suppress(zmq.Again):
        stranger.send_multipart(parts, zmq.NOBLOCK)


def test_nonsense_and_pickles_from_strangers_leave_the_service_unharmed(tmp_path: Path) -> None:
    """Raw messages, whole and spoilt, beside a client that is served."""
    rng = np.random.default_rng(0)
    bomb = pickle.dumps(Bomb(str(tmp_path / "exploded")))
    hello = Writer().write(
        Hello(version=1, name="x", nonce=1, observation_space={}, action_space={})
    )
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        remote = group["robots-0"]._server[0]._listener
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
            stranger.linger = 0
            stranger.connect(address)
            for k in range(300):
                for parts in ([bomb], [b"", bomb], [hello[0], bomb], mutation(rng)(hello)):
                    if parts:
                        say(stranger, parts)
                if k % 10 == 0:
                    group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
                    batch, _ = group.collect_async(deadline=HANG)
            # It is cut off again and again, and dials anew.
            while remote.malformed < 3 or remote.door.num_cut < 3:
                say(stranger, [bomb])
                group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
                batch, _ = group.collect_async(deadline=HANG)
        assert group["robots-0"].clients == ["robots-0/arm"]
        group.close()
        friend.join()
    assert not (tmp_path / "exploded").exists()
    pickle.loads(bomb)
    assert (tmp_path / "exploded").exists(), "the bomb must be a real one"


def test_a_frame_beyond_the_limit_is_not_taken_in() -> None:
    """Its sender is cut off before memory is spent on it."""
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        friend = ClientThread(address, "arm")
        batch, _ = group.reset()
        with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
            stranger.linger = 0
            monitor = stranger.get_monitor_socket(zmq.EVENT_DISCONNECTED)
            stranger.connect(address)
            stranger.send(bytes((64 << 20) + 1))
            while not monitor.poll(0):
                group.step_async(batch.respond(action=np.zeros((1, 2), np.float32)))
                batch, _ = group.collect_async(deadline=HANG)
            stranger.disable_monitor()
            monitor.close()
        assert group["robots-0"]._server[0]._listener.malformed == 0
        group.close()
        friend.join()


def test_a_client_survives_a_server_that_talks_nonsense() -> None:
    """It counts what is no message, and goes on asking to be let in."""
    rng = np.random.default_rng(1)
    done = threading.Event()

    def talk_nonsense() -> None:
        while not done.is_set():
            if router.poll(50):
                route, *parts = router.recv_multipart()
                for _ in range(50):
                    router.send_multipart([route, *mutation(rng)(parts)])

    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        port = router.bind_to_random_port("tcp://127.0.0.1")
        thread = threading.Thread(target=talk_nonsense)
        thread.start()
        env = CountingEnv()
        with RemoteEnvClient(env, "127.0.0.1", port, name="arm") as client:
            while client._session.malformed <= 20:
                with pytest.raises(TimeoutError):
                    client.connect(timeout=0.5)
            assert "asking to be let in" in client.state
        done.set()
        thread.join()
    assert env.closed
    assert env.steps == env.resets == 0


def test_a_client_without_a_server_says_so() -> None:
    """The message has the address and the reason."""
    with (
        RemoteEnvClient(CountingEnv(), "127.0.0.1", 1, name="arm") as client,
        pytest.raises(
            TimeoutError, match=r"tcp://127.0.0.1:1 did not let 'arm' in.*nobody answers"
        ),
    ):
        client.connect(timeout=2.0)
