"""`Listener`: the sockets of an env_server, a ZMQ ROUTER without a thread.

Rule: one descriptor wakes the driver, which then calls `Listener.pump`. `ServerSessions` decides
what messages mean. The descriptor is that of a set: those of ZMQ, which only report changes, and a
`WakeUp`, which is set whenever there is work without a change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

import zmq

from rlightning_aio._core.hosts.descriptors import READABLE, WakeUp, new_descriptor_set
from rlightning_aio._core.hosts.env_server.authenticator import Authenticator
from rlightning_aio._core.hosts.env_server.connection_limiter import ConnectionLimiter
from rlightning_aio._core.hosts.env_server.rate_limiter import (
    DROPPED_FRAME_COST,
    MAX_SAVED,
    PEERS_SHARE,
    RateLimiter,
)
from rlightning_aio.errors import StartFailed
from rlightning_aio.protocol.net.limited_log import LimitedLog
from rlightning_aio.protocol.net.wire import MAX_FRAME_BYTES, MAX_PARTS, ping_ms
from rlightning_aio.remote.zmq_messages import is_readable, next_frame, receive_parts, send_parts

if TYPE_CHECKING:
    import select

    from rlightning_aio._core.hosts.env_server.settings import ServerSettings
    from rlightning_aio.protocol.net.server_session import ServerSessions
    from rlightning_aio.protocol.net.wire import Part

__all__ = ["Listener"]

_MESSAGES_PER_PUMP: Final = 1000
"""Upper limit, so that a flood does not occupy the driver."""
_MAX_UNSENT_PER_CLIENT: Final = 100
_MAX_UNREAD_PER_CLIENT: Final = 100
_LINGER_MS: Final = 200
_MIN_UPDATE_SECONDS: Final = 0.01
"""Time between two updates of connections while messages wait."""
_MAX_CONSECUTIVE_UPDATES: Final = 50
_UPDATES_PER_SECOND: Final = 50
"""If more connections come and go, several are processed by one update."""


class Listener:
    """Exchanges messages with env clients; never blocks.

    Args:
        server_id: env_id of the env_server.
        settings: see `ServerSettings`.
        sessions: reads and writes the messages.

    Attributes:
        connections: limits connections, once the listener has started.

    Raises:
        ConfigError: the keys can't be read.
    """

    def __init__(self, server_id: str, settings: ServerSettings, sessions: ServerSessions) -> None:
        self.server_id = server_id
        self._settings = settings
        self._sessions = sessions
        self._limiter = RateLimiter(MAX_SAVED, PEERS_SHARE)
        self._log = LimitedLog(server_id)
        self._authenticator = Authenticator(settings.keys, self._limiter, self._log)
        self._update_limiter = RateLimiter(_MAX_CONSECUTIVE_UPDATES, _UPDATES_PER_SECOND)
        self._update_at: float | None = None
        self._updated_at = 0.0
        self._ignores_connections = False
        self._is_skipping = False
        self._address: str | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._router: zmq.Socket[bytes]
        self.connections: ConnectionLimiter
        self._descriptors: select.epoll
        self._wake_up: WakeUp
        self._is_woken = False

    @property
    def address(self) -> str:
        """Address for clients, as ``tcp://host:port``."""
        if self._address is None:
            raise RuntimeError(f"{self.server_id} does not listen yet")
        return self._address

    # -- life -----------------------------------------------------------------------

    def start(self) -> None:
        """Listen.

        Raises:
            StartFailed: the address is not available.
        """
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
        interval, patience = ping_ms(settings.heartbeat)
        # Messages to a closed connection must fail, not vanish.
        router.set(zmq.ROUTER_MANDATORY, 1)
        router.set(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        router.set(zmq.SNDHWM, _MAX_UNSENT_PER_CLIENT)
        router.set(zmq.RCVHWM, _MAX_UNREAD_PER_CLIENT)
        router.set(zmq.LINGER, _LINGER_MS)
        router.set(zmq.HEARTBEAT_IVL, interval)
        router.set(zmq.HEARTBEAT_TIMEOUT, patience)
        self._authenticator.open(context, router)
        host = "127.0.0.1" if settings.host == "localhost" else settings.host
        if ":" in host:
            router.set(zmq.IPV6, 1)
            host = f"[{host}]"
        connections = self.connections = ConnectionLimiter(
            context,
            router,
            self._limiter,
            self._log,
            has_keys=self._authenticator.has_keys,
            used_routes=self._sessions.routes,
        )
        try:
            router.bind(f"tcp://{host}:{settings.port or '*'}")
        except zmq.ZMQError:
            connections.close()
            raise
        self._address = router.get_string(zmq.LAST_ENDPOINT).rstrip("\0")
        connections.watch_port(int(self._address.rpartition(":")[2]))
        self._descriptors.register(_descriptor(router), READABLE)
        self._descriptors.register(connections.fileno(), READABLE)
        self._descriptors.register(self._authenticator.fileno(), READABLE)

    def close(self) -> None:
        """Send all clients a goodbye and stop listening; idempotent, takes at most 0.2 s."""
        if self._context is None:
            return
        context, self._context = self._context, None
        if self._address is not None:
            self._sessions.close("the trainer closed its group")
            self._send()
            self.connections.close()
        self._descriptors.close()
        self._wake_up.close()
        context.destroy(linger=_LINGER_MS)

    # -- waiting --------------------------------------------------------------------

    def fileno(self) -> int:
        """Return a descriptor that is readable while `pump` has something to do."""
        return self._descriptors.fileno()

    def is_readable(self) -> bool:
        """Return True if `pump` has something to do. Asking may clear the descriptor."""
        return self._is_woken or is_readable(self._router)

    def deadline(self) -> float | None:
        """Return the time at which `pump` is due even without a message; None if never."""
        times = [self._sessions.deadline(), self._update_at]
        return min([time for time in times if time is not None], default=None)

    def _call_back(self) -> None:
        """Make the driver pump once more, though no change will wake it."""
        if not self._is_woken:
            self._is_woken = True
            self._wake_up.set()

    # -- messages -------------------------------------------------------------------

    def pump(self, now: float) -> None:
        """Read all messages and send all that wait; never blocks."""
        if self._is_woken:
            self._is_woken = False
            self._wake_up.clear()
        # This question is what clears ZMQ's descriptor.
        has_message = is_readable(self._router)
        if not has_message or now >= self._updated_at + _MIN_UPDATE_SECONDS:
            # Until the next update, descriptors of their own report connections.
            self._updated_at = now
            self._update_connections(now)
            # One that has ended meanwhile may have sent something before that.
            has_message = has_message or is_readable(self._router)
        for _ in range(_MESSAGES_PER_PUMP):
            if not has_message:
                break
            has_message = self._receive(now) and is_readable(self._router)
        if has_message:
            self._call_back()
        else:
            # What these connections sent has been read.
            self._end_closed()
        self._sessions.tick(now)
        self._send()

    def _update_connections(self, now: float) -> None:
        """Process connections that came or went, unless many did so a moment ago."""
        if self._ignores_connections and self._update_at is not None and now < self._update_at:
            return
        any_change = self.connections.update(now)
        if self._authenticator.answer_questions(now) or any_change:
            self._update_limiter.spend(1, now)
        is_busy = self._update_limiter.budget(now) < 1
        self._update_at = (
            self._update_limiter.time_of(1, now) if is_busy else self._authenticator.deadline(now)
        )
        if is_busy != self._ignores_connections:
            self._ignores_connections = is_busy
            for source in (self.connections, self._authenticator):
                self._descriptors.modify(source.fileno(), 0 if is_busy else READABLE)

    def _receive(self, now: float) -> bool:
        """Read one message, or some parts of a dropped one. Return False if there is none."""
        frame = next_frame(self._router)
        if frame is None:
            return False
        connection = None if self._is_skipping else self.connections.sender(frame, now)
        if connection is None:
            self._drop(frame, now)
            return True
        parts: list[Part] = []
        if frame.more:
            first = self._router.recv(zmq.NOBLOCK, copy=False)
            parts = receive_parts(self._router, first, MAX_PARTS + 1)
            self._is_skipping = self._router.get(zmq.RCVMORE) != 0
        effect = self._sessions.receive(connection.route, parts, now)
        self.connections.record(connection, effect, sum([len(part) for part in parts]), now)
        if self._is_skipping:
            self.connections.cut(connection)
        return True

    def _drop(self, frame: zmq.Frame, now: float) -> None:
        """Discard a message from `frame` on, or the first parts of one with very many."""
        num_dropped = 1
        while frame.more and num_dropped <= MAX_PARTS:
            frame = self._router.recv(zmq.NOBLOCK, copy=False)
            num_dropped += 1
        self._is_skipping = frame.more
        self._limiter.spend(num_dropped * DROPPED_FRAME_COST, now)

    def flush(self) -> None:
        """Send new requests, and make sure that results wake the driver."""
        self._send()
        if self._sessions.has_results:
            self._call_back()

    def _end_closed(self) -> None:
        """End the sessions of connections that are gone."""
        for route in self.connections.take_closed():
            self._sessions.disconnected(route)

    def _send(self) -> None:
        outbox = self._sessions.outbox
        if not outbox:
            return
        while outbox:
            route, parts = outbox.popleft()
            try:
                send_parts(self._router, [route, *parts])
            except zmq.ZMQError as error:
                if error.errno == zmq.EAGAIN:  # The client reads nothing.
                    self.connections.cut_route(route)
                elif error.errno != zmq.EHOSTUNREACH:
                    raise
                self._sessions.disconnected(route)
        # Sending reads ZMQ's signals, so the descriptor may not report waiting messages.
        if is_readable(self._router):
            self._call_back()


def _descriptor(socket: zmq.Socket[bytes]) -> int:
    return cast("int", socket.get(zmq.FD))
