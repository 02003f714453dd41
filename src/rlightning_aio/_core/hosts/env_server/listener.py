"""`Listener`: the sockets of an env_server, a ZMQ ROUTER without a thread.

Rule: one descriptor wakes the driver, and `ServerSessions` decides what messages mean. The
descriptor is that of a set: those of ZMQ, which only report changes, and a `WakeUp`, which is set
whenever there is work without a change.

ZMQ asks about every connection in the middle of its handshake (ZAP, RFC 27), and reads nothing from
it before the answer, which `zmq.auth` gives. ZMQ asks without keys, too: with an authenticator it
refuses protocols before ZMTP 3, and a connection in one of these that came while the socket closes
would end the process (an assertion of libzmq 4.3).
"""

from __future__ import annotations

import contextlib
import struct
from typing import TYPE_CHECKING, Final, cast

import zmq
from zmq.auth import Authenticator

from rlightning_aio._core.hosts.descriptors import READABLE, WakeUp, new_descriptor_set
from rlightning_aio.errors import StartFailed
from rlightning_aio.protocol.error_text import LOG
from rlightning_aio.protocol.net.wire import DEFAULT_HEARTBEAT
from rlightning_aio.remote.keys import ListedKeys, read_server_keys
from rlightning_aio.remote.zmq_messages import (
    is_readable,
    next_frame,
    next_message,
    receive_parts,
    send_parts,
    set_limits,
)

if TYPE_CHECKING:
    import select

    from rlightning_aio._core.hosts.env_server.settings import ServerSettings
    from rlightning_aio.protocol.net.server_session import ServerSessions
    from rlightning_aio.protocol.net.wire import Part

_MESSAGES_PER_READ: Final = 1000
"""Upper limit, so that the driver does other things in between."""
_MAX_UNSENT_PER_CLIENT: Final = 100
_MAX_UNREAD_PER_CLIENT: Final = 100
_MAX_WAITING_CONNECTIONS: Final = 32
"""Connections that the system holds until ZMQ accepts them."""
_LINGER_MS: Final = 200
_FAILED: Final = (
    int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL),
    int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL),
)
"""Events of handshakes that failed. Which of them comes depends on the end that notices first."""
_EVENTS: Final = int(zmq.EVENT_ACCEPTED) | int(zmq.EVENT_DISCONNECTED) | sum(_FAILED)
_EVENT: Final = struct.Struct("=Hi")
_DOMAIN: Final = "rlightning-aio"


class Listener:
    """Exchanges messages with env clients; never blocks.

    Args:
        server_id: env_id of the env_server.
        settings: see `ServerSettings`.
        sessions: reads and writes the messages.

    Raises:
        ConfigError: the keys can't be read.
    """

    def __init__(self, server_id: str, settings: ServerSettings, sessions: ServerSessions) -> None:
        self.server_id = server_id
        self._settings = settings
        self._sessions = sessions
        self._keys = None if settings.keys is None else read_server_keys(settings.keys)
        self._listed = None if self._keys is None else ListedKeys(self._keys.clients)
        self._authenticator: Authenticator
        self._address: str | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._router: zmq.Socket[bytes]
        self._monitor: zmq.Socket[bytes]
        self._descriptors: select.epoll
        self._wake_up: WakeUp
        self._is_woken = False
        self._warned_of_handshakes = False
        # The open connections by their descriptors, with the route of a session.
        self._open: dict[int, bytes | None] = {}
        self._gone: list[bytes] = []

    @property
    def address(self) -> str:
        """Address for clients, as ``tcp://host:port``."""
        if self._address is None:
            raise RuntimeError(f"{self.server_id} does not listen yet")
        return self._address

    # -- life -----------------------------------------------------------------------

    def start(self) -> None:
        """Listen, if it doesn't yet.

        Raises:
            StartFailed: the address is not available.
        """
        if self._context is not None:
            return
        self._context = zmq.Context[zmq.Socket[bytes]]()
        self._descriptors = new_descriptor_set()
        self._wake_up = WakeUp()
        self._descriptors.register(self._wake_up.fileno(), READABLE)
        try:
            self._listen(self._context)
        except zmq.ZMQError as error:
            settings = self._settings
            self.close()
            raise StartFailed(
                f"{self.server_id} can't listen on {settings.host}:{settings.port}: "
                f"{error.strerror}; choose another env_kwargs.port (0 picks a free one) or host",
                env_id=self.server_id,
            ) from None

    def _listen(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        settings = self._settings
        router = self._router = context.socket(zmq.ROUTER)
        set_limits(router, settings.heartbeat or DEFAULT_HEARTBEAT)
        # Messages to a closed connection must fail, not vanish.
        router.set(zmq.ROUTER_MANDATORY, 1)
        router.set(zmq.SNDHWM, _MAX_UNSENT_PER_CLIENT)
        router.set(zmq.RCVHWM, _MAX_UNREAD_PER_CLIENT)
        router.set(zmq.LINGER, _LINGER_MS)
        router.set(zmq.BACKLOG, _MAX_WAITING_CONNECTIONS)
        self._authenticate(context, router)
        host = "127.0.0.1" if settings.host == "localhost" else settings.host
        if ":" in host:
            router.set(zmq.IPV6, 1)
            host = f"[{host}]"
        self._monitor = router.get_monitor_socket(_EVENTS)
        router.bind(f"tcp://{host}:{settings.port or '*'}")
        self._address = router.get_string(zmq.LAST_ENDPOINT).rstrip("\0")
        for socket in (router, self._monitor, self._questions):
            self._descriptors.register(_descriptor(socket), READABLE)

    def _authenticate(
        self, context: zmq.Context[zmq.Socket[bytes]], router: zmq.Socket[bytes]
    ) -> None:
        """Make ZMQ ask about all connections to `router`, which is not bound yet."""
        self._authenticator = Authenticator(context)
        self._authenticator.start()
        router.set_string(zmq.ZAP_DOMAIN, _DOMAIN)
        router.set(zmq.ZAP_ENFORCE_DOMAIN, 1)
        if self._keys is not None:
            self._authenticator.configure_curve_callback(_DOMAIN, self._listed)
            router.set(zmq.CURVE_SERVER, 1)
            router.set(zmq.CURVE_SECRETKEY, self._keys.secret)

    @property
    def _questions(self) -> zmq.Socket[bytes]:
        """The socket on which ZMQ asks."""
        return cast("zmq.Socket[bytes]", self._authenticator.zap_socket)  # pyright: ignore[reportUnknownMemberType]

    def close(self) -> None:
        """Send all clients a goodbye and stop listening; idempotent, takes at most 0.2 s."""
        if self._context is None:
            return
        context, self._context = self._context, None
        if self._address is not None:
            self._sessions.close("the trainer closed its group")
            self.flush()
        self._descriptors.close()
        self._wake_up.close()
        self._router.disable_monitor()
        context.destroy(linger=_LINGER_MS)

    # -- waiting --------------------------------------------------------------------

    def fileno(self) -> int:
        """Return a descriptor that is readable while `on_readable` has something to do."""
        return self._descriptors.fileno()

    def is_readable(self) -> bool:
        """Return True if `on_readable` has something to do. Asking may clear the descriptor."""
        return self._context is not None and (self._is_woken or is_readable(self._router))

    def _call_back(self) -> None:
        """Make the driver call `on_readable` once more, though no change will wake it."""
        if not self._is_woken:
            self._is_woken = True
            self._wake_up.set()

    # -- messages -------------------------------------------------------------------

    def on_readable(self) -> None:
        """Read all messages and send all that wait; never blocks."""
        if self._is_woken:
            self._is_woken = False
            self._wake_up.clear()
        self._answer_questions()
        self._read_events()
        # What a connection sent before its end counts, so its messages are read after that event.
        # This question is what clears ZMQ's descriptor.
        has_message = is_readable(self._router)
        for _ in range(_MESSAGES_PER_READ):
            if not has_message:
                break
            has_message = self._receive() and is_readable(self._router)
        if has_message:
            self._call_back()
        else:
            gone, self._gone = self._gone, []
            for route in gone:
                self._sessions.disconnected(route)
        self.flush()

    def on_writable(self) -> None:
        """Do nothing: ZMQ sends by itself, so no driver calls this."""

    def _answer_questions(self) -> None:
        """Say which connections continue, of those whose handshakes have come so far."""
        asked = self._questions
        while is_readable(asked) and (question := next_message(asked)) is not None:
            with contextlib.suppress(StopIteration):  # It awaits nothing.
                self._authenticator.handle_zap_message(question).send(None)

    def _read_events(self) -> None:
        """Note which connections have come and gone."""
        while is_readable(self._monitor) and (parts := next_message(self._monitor)) is not None:
            # The second part is an address, which says less than the descriptor.
            event, descriptor = _EVENT.unpack(parts[0])
            if event in _FAILED:  # There is a reason in place of the descriptor.
                self._warn_of_handshake()
                continue
            if (route := self._open.pop(descriptor, None)) is not None:
                self._gone.append(route)
            if event == zmq.EVENT_ACCEPTED:
                self._open[descriptor] = None

    def _warn_of_handshake(self) -> None:
        if not self._warned_of_handshakes:
            self._warned_of_handshakes = True
            LOG.warning(
                "%s: a handshake failed: it took too long, or the other end has other keys than "
                "these, or none; further ones are not reported",
                self.server_id,
            )

    def _receive(self) -> bool:
        """Read one message. Return False if there is none."""
        frame = next_frame(self._router)
        if frame is None:
            return False
        route = frame.bytes
        parts: list[Part] = []
        if frame.more:
            parts = receive_parts(self._router, self._router.recv(zmq.NOBLOCK, copy=False))
        if self._sessions.holds(route):
            self._sessions.receive(route, parts)
        elif self._is_open(frame):
            self._sessions.receive(route, parts, self._names_of(frame))
            if self._sessions.holds(route):
                self._open[frame.get(zmq.SRCFD)] = route
        return True

    def _names_of(self, frame: zmq.Frame) -> set[str] | None:
        """Return the names that the key of a message's sender was made for; None without keys."""
        if self._listed is None:
            return None
        return self._listed.names(cast("str", frame.get("User-Id")).encode())

    def _is_open(self, frame: zmq.Frame) -> bool:
        """Return True if a connection without a session that sent `frame` is still there."""
        self._read_events()  # The connection may be newer than those that were read last.
        descriptor = frame.get(zmq.SRCFD)
        # A descriptor may belong to another connection by now.
        return descriptor in self._open and self._open[descriptor] in {None, frame.bytes}

    def flush(self) -> None:
        """Send all that waits."""
        outbox = self._sessions.outbox
        if not outbox:
            return
        while outbox:
            route, parts = outbox.popleft()
            try:
                send_parts(self._router, [route, *parts])
            except zmq.ZMQError as error:
                # The connection is gone, or the client reads nothing.
                if error.errno not in {zmq.EHOSTUNREACH, zmq.EAGAIN}:
                    raise
                self._sessions.disconnected(route)
                self._call_back()  # So that the driver applies what that has posted.
        # Sending reads ZMQ's signals, so the descriptor may not report waiting messages.
        if is_readable(self._router):
            self._call_back()


def _descriptor(socket: zmq.Socket[bytes]) -> int:
    return cast("int", socket.get(zmq.FD))
