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

from rlightning_aio.errors import ConfigError, StartFailed
from rlightning_aio.hosts.allowance import DROPPED_FRAME, SAVED, STRANGERS_SHARE, Allowance
from rlightning_aio.hosts.door import Door
from rlightning_aio.hosts.gate import Gate
from rlightning_aio.protocol.net.server_session import PATIENCE, ServerSessions
from rlightning_aio.protocol.net.wire import MAX_FRAME_BYTES, MAX_PARTS
from rlightning_aio.remote.keys import read_server_keys
from rlightning_aio.remote.parts import is_readable, receive_parts, send_parts

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
_SECONDS_BETWEEN_LOOKS: Final = 0.01
"""At those who come and go, while clients have something to say; else whenever there is time."""
_LOOKS_IN_A_ROW: Final = 50
_LOOKS_A_SECOND: Final = 50
"""At those who come and go: where there are more, they wait and are looked at together."""

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

    Attributes:
        door: its connections, once it listens.

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
        self._allowance = Allowance(SAVED, STRANGERS_SHARE)
        self._gate = Gate(settings.keys, self._allowance)
        self._looks = Allowance(_LOOKS_IN_A_ROW, _LOOKS_A_SECOND)
        self._look_at: float | None = None
        self._looked_at = 0.0
        self._is_deaf = False
        self._is_skipping = False
        self._address: str | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._router: zmq.Socket[bytes]
        self.door: Door
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
        router.set(zmq.HEARTBEAT_IVL, max(1, int(1000 * settings.heartbeat / PATIENCE)))
        router.set(zmq.HEARTBEAT_TIMEOUT, max(2, int(2000 * settings.heartbeat / PATIENCE)))
        self._gate.open(context, router)
        host = "127.0.0.1" if settings.host == "localhost" else settings.host
        if ":" in host:
            router.set(zmq.IPV6, 1)
            host = f"[{host}]"
        door = self.door = Door(
            context,
            router,
            self._allowance,
            has_keys=self._gate.has_keys,
            spoken_over=self._sessions.routes,
        )
        try:
            router.bind(f"tcp://{host}:{settings.port or '*'}")
        except zmq.ZMQError:
            door.close()
            raise
        self._address = router.get_string(zmq.LAST_ENDPOINT).rstrip("\0")
        door.watch(int(self._address.rpartition(":")[2]))
        self._epoll.register(_descriptor(router), select.EPOLLIN)
        self._epoll.register(door.fileno(), select.EPOLLIN)
        self._epoll.register(self._gate.fileno(), select.EPOLLIN)

    def fileno(self) -> int:
        """Readable, and staying so, while there is something for `pump` to do."""
        return self._epoll.fileno()

    def is_readable(self) -> bool:
        """Whether `pump` would find anything; asking may silence the descriptor."""
        return self._has_more or is_readable(self._router)

    def deadline(self) -> float | None:
        """When `pump` is due even if nothing comes (monotonic seconds); None if never."""
        due = self._sessions.deadline()
        if due is None or self._look_at is None:
            return self._look_at if due is None else due
        return min(due, self._look_at)

    def pump(self, now: float) -> None:
        """Read all there is, send what is due; never blocks."""
        if self._has_more:
            self._has_more = False
            os.eventfd_read(self._more)
        # Asking is what makes ZMQ's descriptor unreadable again.
        has_message = is_readable(self._router)
        if not has_message or now >= self._looked_at + _SECONDS_BETWEEN_LOOKS:
            # It shows what there is to see until then by its own descriptors.
            self._looked_at = now
            self._look(now)
        for _ in range(_MESSAGES_A_PUMP):
            if not has_message:
                break
            self._receive(now)
            has_message = is_readable(self._router)
        else:
            self._call_back()
        self._sessions.tick(now)
        self._flush(now)

    def _look(self, now: float) -> None:
        """See who comes and goes, unless there was much of that a moment ago."""
        if self._is_deaf and self._look_at is not None and now < self._look_at:
            return
        came_or_went = self.door.look()
        if self._gate.look(now) or came_or_went:
            self._looks.spend(1, now)
        is_busy = self._looks.left(now) < 1
        self._look_at = self._looks.time_of(1, now) if is_busy else self._gate.deadline(now)
        if is_busy != self._is_deaf:
            self._is_deaf = is_busy
            for source in (self.door, self._gate):
                self._epoll.modify(source.fileno(), 0 if is_busy else select.EPOLLIN)

    def _receive(self, now: float) -> None:
        """Read one message, or some parts of one that is dropped."""
        frame = self._router.recv(zmq.NOBLOCK, copy=False)
        connection = None if self._is_skipping else self.door.connection(frame, now)
        if connection is None:
            self._drop(frame, now)
            return
        parts: list[Part] = []
        if frame.more:
            first = self._router.recv(zmq.NOBLOCK, copy=False)
            parts = receive_parts(self._router, first, MAX_PARTS + 1)
            self._is_skipping = self._router.get(zmq.RCVMORE) != 0
        heard = self._sessions.receive(connection.route, connection.user, parts, now)
        self.door.judge(connection, heard, sum([len(part) for part in parts]), now)
        if self._is_skipping:
            self.door.cut(connection)

    def _drop(self, frame: zmq.Frame, now: float) -> None:
        """Throw a message away from `frame` on: all of it, if it is none of very many parts."""
        dropped = 1
        while frame.more and dropped <= MAX_PARTS:
            frame = self._router.recv(zmq.NOBLOCK, copy=False)
            dropped += 1
        self._is_skipping = frame.more
        self._allowance.spend(dropped * DROPPED_FRAME, now)

    def flush(self, now: float) -> None:
        """Send what was asked for, and see to it that nothing is left that wakes nobody."""
        self._flush(now)
        if self._sessions.has_results:
            self._call_back()

    def _flush(self, now: float) -> None:
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
        if is_readable(self._router):
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
        """Send a client away; see `ServerSessions.dismiss`."""
        self._sessions.dismiss(client, cause)

    def check(self, client: str, action: Any, extras: Mapping[str, Any]) -> None:
        """Raises `BadAction` if a step can't be sent; see `ServerSessions.check`."""
        self._sessions.check(client, action, extras)

    def check_reset(self, client: str, seed: int | None, options: dict[str, Any]) -> None:
        """Raises `ValueError` if a reset can't be sent; see `ServerSessions.check_reset`."""
        self._sessions.check_reset(client, seed, options)

    def submit(
        self, client: str, number: int, action: Any, extras: Mapping[str, Any], now: float
    ) -> bool:
        """Ask a client to step, with the next `flush`; see `ServerSessions.submit`."""
        return self._sessions.submit(client, number, action, extras, now)

    def submit_reset(
        self,
        client: str,
        number: int,
        seed: int | list[int] | None,
        options: dict[str, Any] | None,
        now: float,
    ) -> bool:
        """Ask a client to reset, with the next `flush`; see `ServerSessions.submit_reset`."""
        return self._sessions.submit_reset(client, number, seed, options, now)

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
            self.door.close()
        self._epoll.close()
        os.close(self._more)
        context.destroy(linger=_LINGER_MS)


def _descriptor(socket: zmq.Socket[bytes]) -> int:
    return cast("int", socket.get(zmq.FD))
