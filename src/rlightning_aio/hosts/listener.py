"""`Listener`: the trainer's end of env_server, a ZMQ ROUTER without a thread.

Rule: one descriptor wakes the driver, which then calls `Listener.pump`; everything
that means something happens in `protocol.net.server_session`. The descriptor is an epoll
over ZMQ's own, which only tell that something changed, and an eventfd that is set
whenever there is something to be had without a change.
"""

from __future__ import annotations

import difflib
import ipaddress
import logging
import os
import select
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import zmq
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError
from zmq.utils import z85

from rlightning_aio.errors import ConfigError, StartFailed
from rlightning_aio.hosts.door import Door
from rlightning_aio.protocol.net.server_session import PATIENCE, ServerSessions
from rlightning_aio.protocol.net.wire import MAX_FRAME_BYTES, MAX_PARTS
from rlightning_aio.remote.keys import AllowedKeys, read_server_keys
from rlightning_aio.remote.parts import receive_parts, send_parts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.protocol.net.server_session import ClientTraits, RemoteResult
    from rlightning_aio.protocol.net.wire import Part
    from rlightning_aio.types import EnvMeta

__all__ = ["Listener", "ServerSettings", "server_settings"]

_MESSAGES_A_PUMP: Final = 1000
"""Read in one go at most, so that a flood doesn't keep the driver."""
_UNSENT_A_CLIENT: Final = 100
_UNREAD_A_CLIENT: Final = 100
_LINGER_MS: Final = 200
_HANDSHAKE_MS: Final = 5000
_SECONDS_BETWEEN_WARNINGS: Final = 10.0

_EVENTS: Final = int(zmq.EVENTS)
_POLLIN: Final = int(zmq.POLLIN)

_log = logging.getLogger(__name__)


class ServerSettings(BaseModel):
    """``env_kwargs`` of an env_server entry."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; a public one needs ``keys``, or ``insecure: true``."""
    port: int = Field(default=0, ge=0, le=65535, validation_alias=AliasChoices("port", "zmq_port"))
    """Port to listen on; 0 picks a free one."""
    min_clients: int = Field(default=1, ge=1)
    """Clients that ``reset`` waits for."""
    connect_timeout: float = Field(default=60.0, gt=0)
    """Seconds that ``reset`` waits for them."""
    heartbeat: float = Field(default=5.0, ge=0.1, le=86400)
    """Seconds within which a dead client is found."""
    keys: Path | None = None
    """Its directory, made by ``rlightning-aio keygen``; only clients listed there come in."""
    insecure: bool = False
    """Listen on a public address without keys: a machine that reaches it may be an env."""


_FIELDS: Final = (*ServerSettings.model_fields, "zmq_port")


def server_settings(config: EnvConfig) -> ServerSettings:
    """The checked ``env_kwargs`` of an env_server entry.

    Raises:
        ConfigError: naming entry and field.
    """
    place = f"entry {config.name!r}, env_kwargs"
    for name in config.env_kwargs:
        if name not in _FIELDS:
            near = difflib.get_close_matches(name, _FIELDS, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise ConfigError(f"{place}.{name}: unknown field; {hint}Known: {', '.join(_FIELDS)}")
    try:
        settings = ServerSettings.model_validate(config.env_kwargs)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        raise ConfigError(
            f"{place}.{fault['loc'][0]}: {fault['msg']}, got {fault['input']!r}"
        ) from None
    if settings.keys is not None:
        read_server_keys(settings.keys)
    if not (_is_loopback(settings.host) or settings.keys or settings.insecure):
        raise ConfigError(
            f"{place}.host: {settings.host!r} can be reached from other machines, and without "
            "keys anyone there could pose as an env; set keys (see `rlightning-aio keygen`), "
            "or insecure: true if the network is your own"
        )
    return settings


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Listener:
    """Listens for env clients and speaks with them; never blocks.

    Args:
        server_id: env_id of the env_server; its clients' envs are ``<server_id>/<name>``.
        settings: see `ServerSettings`.
        step_timeout, reset_timeout: seconds after which a client that owes a step or a
            reset counts as lost; None for never.
        objection: why an env may not join, if there is a reason.

    Raises:
        ConfigError: the keys can't be read.
    """

    def __init__(
        self,
        server_id: str,
        settings: ServerSettings,
        *,
        step_timeout: float | None = None,
        reset_timeout: float | None = None,
        objection: Callable[[EnvMeta], str | None] = lambda _: None,
    ) -> None:
        self.server_id = server_id
        self.settings = settings
        self._sessions = ServerSessions(
            server_id,
            heartbeat=settings.heartbeat,
            step_timeout=step_timeout,
            reset_timeout=reset_timeout,
            objection=objection,
        )
        self._gate = None if settings.keys is None else _Gate(settings.keys)
        self._is_skipping = False
        self._address: str | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._router: zmq.Socket[bytes]
        self._door: Door
        self._epoll: select.epoll
        self._more = -1
        self._has_more = False

    @property
    def address(self) -> str:
        """Where clients connect to, as ``tcp://host:port``."""
        if self._address is None:
            raise RuntimeError(f"{self.server_id} does not listen yet")
        return self._address

    @property
    def clients(self) -> Mapping[str, EnvMeta]:
        """The envs of the clients that are here, by client name."""
        return self._sessions.clients

    @property
    def malformed(self) -> int:
        """Messages that were dropped because they were none."""
        return self._sessions.malformed

    @property
    def num_cut(self) -> int:
        """Connections that were cut off because they were of no use."""
        return self._door.num_cut

    def start(self) -> None:
        """Listen.

        Raises:
            StartFailed: the address can't be had.
        """
        self._context = zmq.Context[zmq.Socket[bytes]]()
        self._epoll = select.epoll()
        self._more = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll.register(self._more, select.EPOLLIN)
        try:
            self._listen(self._context)
        except zmq.ZMQError as error:
            settings = self.settings
            self.close()
            raise StartFailed(
                f"{self.server_id} can't listen on {settings.host}:{settings.port}: "
                f"{error.strerror}; choose another env_kwargs.port (0 picks a free one) or host",
                env_id=self.server_id,
            ) from None

    def _listen(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        settings = self.settings
        router = self._router = context.socket(zmq.ROUTER)
        # Sends to a connection that is no more must fail, not vanish.
        router.set(zmq.ROUTER_MANDATORY, 1)
        router.set(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        router.set(zmq.SNDHWM, _UNSENT_A_CLIENT)
        router.set(zmq.RCVHWM, _UNREAD_A_CLIENT)
        router.set(zmq.LINGER, _LINGER_MS)
        router.set(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        router.set(zmq.HEARTBEAT_IVL, max(1, int(1000 * settings.heartbeat / PATIENCE)))
        router.set(zmq.HEARTBEAT_TIMEOUT, max(2, int(2000 * settings.heartbeat / PATIENCE)))
        if self._gate is not None:
            self._epoll.register(self._gate.open(context), select.EPOLLIN)
            router.set(zmq.CURVE_SERVER, 1)
            router.set(zmq.CURVE_SECRETKEY, self._gate.secret)
            router.set_string(zmq.ZAP_DOMAIN, "rlightning-aio")
        host = "127.0.0.1" if settings.host == "localhost" else settings.host
        if ":" in host:
            router.set(zmq.IPV6, 1)
            host = f"[{host}]"
        door = self._door = Door(context, router, has_keys=self._gate is not None)
        try:
            router.bind(f"tcp://{host}:{settings.port or '*'}")
        except zmq.ZMQError:
            door.close()
            raise
        self._address = router.get_string(zmq.LAST_ENDPOINT).rstrip("\0")
        door.watch(int(self._address.rpartition(":")[2]))
        self._epoll.register(_descriptor(router), select.EPOLLIN)
        self._epoll.register(door.fileno(), select.EPOLLIN)

    def fileno(self) -> int:
        """Readable, and staying so, while there is something for `pump` to do."""
        return self._epoll.fileno()

    def is_readable(self) -> bool:
        """Whether `pump` would find anything; asking may silence the descriptor."""
        return self._has_more or _is_readable(self._router)

    def deadline(self) -> float | None:
        """When `pump` is due even if nothing comes (monotonic seconds); None if never."""
        return self._sessions.deadline()

    def pump(self, now: float) -> None:
        """Read all there is, send what is due; never blocks."""
        if self._has_more:
            self._has_more = False
            os.eventfd_read(self._more)
        if self._gate is not None:
            self._gate.answer(now)
        self._door.look()
        for _ in range(_MESSAGES_A_PUMP):
            # Asking is what makes ZMQ's descriptor unreadable again.
            if not _is_readable(self._router):
                break
            self._receive(now)
        else:
            self._call_back()
        self._sessions.tick(now)
        self._flush(now)

    def _receive(self, now: float) -> None:
        """Read one message, or one part of one that is dropped."""
        frame = self._router.recv(zmq.NOBLOCK, copy=False)
        if self._is_skipping:
            self._is_skipping = frame.more
            return
        connection = self._door.connection(frame)
        if connection is None:
            self._is_skipping = frame.more
            return
        parts: list[Part] = []
        if frame.more:
            first = self._router.recv(zmq.NOBLOCK, copy=False)
            parts = receive_parts(self._router, first, MAX_PARTS + 1)
            self._is_skipping = self._router.get(zmq.RCVMORE) != 0
        was_useful = self._sessions.receive(connection.route, connection.user, parts, now)
        self._door.judge(connection, was_useful=was_useful)
        if self._is_skipping:
            self._door.cut(connection)

    def _flush(self, now: float) -> None:
        """Send what is due, and see to it that nothing is left that wakes nobody."""
        outbox = self._sessions.outbox
        if not outbox:
            return
        while outbox:
            route, parts = outbox.popleft()
            try:
                send_parts(self._router, [route, *parts])
            except zmq.Again:
                # It reads nothing, or slowly; what is lost here is asked for again.
                continue
            except zmq.ZMQError as error:
                if error.errno != zmq.EHOSTUNREACH:
                    raise
                self._sessions.unreachable(route, now)
        # Sending takes in what ZMQ has to tell, so its descriptor may have fallen silent.
        if _is_readable(self._router):
            self._call_back()

    def _call_back(self) -> None:
        """Make the driver pump once more, though nothing new will wake it."""
        if not self._has_more:
            self._has_more = True
            os.eventfd_write(self._more, 1)

    def traits(self, client: str) -> ClientTraits:
        """What a client that is here makes of requests."""
        return self._sessions.traits(client)

    def dismiss(self, client: str, cause: str) -> None:
        """Send a client away that is here; it is told `cause`."""
        self._sessions.dismiss(client, cause)

    def check(self, client: str, action: Any) -> None:
        """Raises `BadAction` if `client` can't take `action`; nothing is sent."""
        self._sessions.check(client, action)

    def submit(
        self, client: str, number: int, action: Any, extras: Mapping[str, Any], now: float
    ) -> bool:
        """Ask a client to step; see `ServerSessions.submit`."""
        will_answer = self._sessions.submit(client, number, action, extras, now)
        self._submitted(now)
        return will_answer

    def submit_reset(
        self,
        client: str,
        number: int,
        seed: int | list[int] | None,
        options: dict[str, Any] | None,
        now: float,
    ) -> bool:
        """Ask a client to reset; see `ServerSessions.submit_reset`."""
        will_answer = self._sessions.submit_reset(client, number, seed, options, now)
        self._submitted(now)
        return will_answer

    def _submitted(self, now: float) -> None:
        self._flush(now)
        if self._sessions.has_results:
            self._call_back()

    def take(self) -> list[RemoteResult]:
        """All results that are ready, oldest first; each is handed out once."""
        return self._sessions.take()

    def close(self) -> None:
        """Say goodbye to the clients and stop listening; idempotent, at most 0.2 s."""
        if self._context is None:
            return
        context, self._context = self._context, None
        if self._address is not None:
            self._sessions.close("the trainer closed its group")
            self._flush(0.0)
            self._door.close()
        self._epoll.close()
        os.close(self._more)
        context.destroy(linger=_LINGER_MS)


def _descriptor(socket: zmq.Socket[bytes]) -> int:
    return cast("int", socket.get(zmq.FD))


def _is_readable(socket: zmq.Socket[bytes]) -> bool:
    # Plain ints: an operation on an enum costs as much as the call itself.
    return cast("int", socket.get(_EVENTS)) & _POLLIN != 0


class _Gate:
    """Lets in whose CURVE key lies in the env_server's directory of clients (ZAP, RFC 27).

    Args:
        directory: as `remote.keys.make_keys` lays it out.

    Attributes:
        secret: the env_server's own key.

    Raises:
        ConfigError: the env_server's key can't be read.
    """

    def __init__(self, directory: Path) -> None:
        self.secret, clients = read_server_keys(directory)
        self._allowed = AllowedKeys(clients)
        self._warned_at: float | None = None
        self._socket: zmq.Socket[bytes] | None = None

    def open(self, context: zmq.Context[zmq.Socket[bytes]]) -> int:
        """Begin to be asked; the descriptor that tells of a question."""
        self._socket = context.socket(zmq.REP)
        self._socket.bind("inproc://zeromq.zap.01")
        return _descriptor(self._socket)

    def answer(self, now: float) -> None:
        """Answer all questions; never blocks."""
        socket = self._socket
        while socket is not None and _is_readable(socket):
            version, request_id, _, address, _, mechanism, *credentials = socket.recv_multipart()
            key = z85.encode(credentials[0]) if mechanism == b"CURVE" else b""
            name = self._allowed.owner(key)
            if name is None:
                self._warn(address.decode(errors="replace"), now)
            verdict = (b"400", b"not on the list", b"") if name is None else (
                b"200", b"", name.encode(),
            )  # fmt: skip
            socket.send_multipart([version, request_id, *verdict, b""])

    def _warn(self, address: str, now: float) -> None:
        if self._warned_at is None or now - self._warned_at >= _SECONDS_BETWEEN_WARNINGS:
            self._warned_at = now
            _log.warning(
                "a client at %s has a key that is not in %s", address, self._allowed.directory
            )
