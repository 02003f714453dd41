"""`ConnectionLimiter`: watches the connections of an env_server's socket and ends useless ones.

Rule: ZMQ accepts every connection and reports it through its monitor. A peer that then takes room
or time without becoming a client is cut off. While the trainer is away, ZMQ keeps accepting, but
stops when about a thousand events wait to be read. So no flood takes more descriptors than `ROOM`,
which is added to the process's limit. Deliberately left out: the meaning of messages, and keys.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import zmq

from rlightning_aio._core.hosts.env_server.rate_limiter import CONNECTION_COST, message_cost
from rlightning_aio.protocol.net.server_session import MessageEffect
from rlightning_aio.remote.zmq_messages import is_readable, next_message

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.hosts.env_server.rate_limiter import RateLimiter
    from rlightning_aio.protocol.net.limited_log import LimitedLog

__all__ = ["ConnectionLimiter", "PeerConnection"]

_MAX_CONNECTIONS: Final = 1024
"""At most half as many are clients."""
_MAX_UNREAD_EVENTS: Final = 1001
"""ZMQ waits after this number of events: a thousand of its own, and one of the reader's."""
ROOM: Final = _MAX_CONNECTIONS + _MAX_UNREAD_EVENTS + 64
"""Descriptors that connections take at most; the last ones are for connections that are closing."""
_MAX_WASTED: Final = 32
"""Consecutive messages of a connection without effect."""
_MAX_OVERDRAFT: Final = 0.02
"""Overdraft of unauthenticated peers, in seconds, beyond which their messages are dropped."""
_MAX_CUT_REMEMBERED: Final = 4096

_ACCEPTED: Final = int(zmq.EVENT_ACCEPTED)
_DISCONNECTED: Final = int(zmq.EVENT_DISCONNECTED)
_FAILED: Final = (
    int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL),
    int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL),
)
"""Events of handshakes that failed. Which of them comes depends on the end that notices first."""
_FAILED_HINT: Final = (
    "a handshake failed: it took too long, or the other end has other keys than these, or none"
)
_EVENT: Final = struct.Struct("=Hi")


@dataclass(slots=True, eq=False)
class PeerConnection:
    """One connection that has sent something.

    Attributes:
        route: address for messages to it.
        descriptor: of its socket.
        is_unauthenticated: it has neither proved a key nor sent a message of a session.
        num_wasted: messages without effect since the last one of a session.
    """

    route: bytes
    descriptor: int
    is_unauthenticated: bool
    num_wasted: int = 0


class ConnectionLimiter:
    """Counts connections and cuts off useless ones.

    Args:
        context: of the socket.
        router: the socket, which is not bound yet.
        limiter: for unauthenticated peers, in seconds.
        log: of the env_server.
        has_keys: connections have proved a key.
        used_routes: returns the routes of sessions.

    Attributes:
        num_cut: connections that were cut off.
        num_wasted: messages that were read and had no effect.
        num_dropped: messages that were not read, because the budget was used up.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        router: zmq.Socket[bytes],
        limiter: RateLimiter,
        log: LimitedLog,
        *,
        has_keys: bool,
        used_routes: Callable[[], set[bytes]],
    ) -> None:
        self.num_cut = self.num_wasted = self.num_dropped = 0
        self._limiter = limiter
        self._log = log
        self._router = router
        self._has_keys = has_keys
        self._used_routes = used_routes
        self._port = -1
        self._max_connections = _make_room()
        self._by_route: dict[bytes, PeerConnection] = {}
        self._open: dict[int, PeerConnection | None] = {}
        self._cut: dict[bytes, None] = {}
        self._closed: list[bytes] = []
        name = f"inproc://connections-{id(self)}"
        router.monitor(name, _ACCEPTED | _DISCONNECTED | sum(_FAILED))
        self._events = context.socket(zmq.PAIR)
        self._events.set(zmq.RCVHWM, 1)
        self._events.connect(name)

    def fileno(self) -> int:
        """Return a descriptor that is readable when connections have come or gone."""
        return cast("int", self._events.get(zmq.FD))

    def watch_port(self, port: int) -> None:
        """Allow connections to `port`, and no others, to be cut."""
        self._port = port

    @property
    def num_unauthenticated(self) -> int:
        """Connections that have sent nothing useful yet."""
        return sum(one is None or one.is_unauthenticated for one in self._open.values())

    def update(self, now: float) -> bool:
        """Read events and cut excess connections. Return True if there was an event."""
        events = self._read_events()
        for event, value in events:
            if event in _FAILED:  # The value is a reason instead of a descriptor.
                self._log.warn("handshake", _FAILED_HINT, now)
                continue
            self._note_closed(self._open.pop(value, None))
            if event == _ACCEPTED:
                self._open[value] = None
        excess = len(self._open) - self._max_connections
        if excess > 0:
            # Those that have been useless longest come first.
            used = self._used_routes()
            useless = [fd for fd, one in self._open.items() if one is None or one.route not in used]
            for descriptor in useless[:excess]:
                self._close(descriptor)
        return bool(events)

    def _read_events(self) -> list[tuple[int, int]]:
        events: list[tuple[int, int]] = []
        # A flood does not end, so read only as many as can wait at once.
        while len(events) < 2 * _MAX_UNREAD_EVENTS and is_readable(self._events):
            parts = next_message(self._events)
            if parts is None:
                break
            # The second part is an address, which says less than the descriptor.
            events.append(_EVENT.unpack(parts[0]))
        return events

    def sender(self, frame: zmq.Frame, now: float) -> PeerConnection | None:
        """Return the connection whose message begins with `frame`; None to drop the message."""
        connection = self._connection(frame, now)
        if connection and connection.is_unauthenticated and self._is_used_up(now):
            self.cut(connection)
            connection = None
        self.num_dropped += connection is None
        return connection

    def _is_used_up(self, now: float) -> bool:
        return self._limiter.budget(now) < -_MAX_OVERDRAFT

    def _connection(self, frame: zmq.Frame, now: float) -> PeerConnection | None:
        """Return the connection whose message begins with `frame`; None if it was cut off."""
        route = frame.bytes
        found = self._by_route.get(route)
        if found is None and route not in self._cut:
            # The connection may be newer than the events that were read last.
            self.update(now)
            found = PeerConnection(route, frame.get(zmq.SRCFD), not self._has_keys)
            if found.descriptor not in self._open:  # It is closed already.
                return None
            if self._open[found.descriptor] is not None:
                # A message of a closed connection whose descriptor another one has now.
                self._close(found.descriptor)
                return None
            self._by_route[route] = self._open[found.descriptor] = found
        return found

    def record(
        self, connection: PeerConnection, effect: MessageEffect, num_bytes: int, now: float
    ) -> None:
        """Record the effect of a message of `num_bytes`, and charge the peer for it."""
        if effect is MessageEffect.IN_SESSION:
            if connection.is_unauthenticated:
                self._limiter.refund(CONNECTION_COST)
            connection.is_unauthenticated, connection.num_wasted = False, 0
            return
        connection.num_wasted += 1
        self.num_wasted += 1
        if connection.is_unauthenticated:
            self._limiter.spend(message_cost(num_bytes), now)
        # Tolerate malformed messages from authenticated clients only.
        malformed = effect is MessageEffect.MALFORMED and connection.is_unauthenticated
        if malformed or connection.num_wasted > _MAX_WASTED:
            self.cut(connection)

    def cut(self, connection: PeerConnection) -> None:
        """Close a connection and drop the messages that it has already sent."""
        self._by_route.pop(connection.route, None)
        self._cut[connection.route] = None
        if len(self._cut) > _MAX_CUT_REMEMBERED:
            del self._cut[next(iter(self._cut))]
        if self._open.get(connection.descriptor) is connection:
            self._close(connection.descriptor)

    def _close(self, descriptor: int) -> None:
        self._note_closed(self._open.pop(descriptor))
        self.num_cut += 1
        # ZMQ may have closed it, and another thread may have opened a file with its number.
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as ours:
            if ours.getsockname()[1] == self._port and ours.type == socket.SOCK_STREAM:
                ours.shutdown(socket.SHUT_RDWR)

    def cut_route(self, route: bytes) -> None:
        """Close the connection of a client that does not read."""
        if (connection := self._by_route.get(route)) is not None:
            self.cut(connection)

    def take_closed(self) -> list[bytes]:
        """Return the routes that have been closed since the last call, by either side.

        Call it when all messages have been read.
        """
        closed, self._closed = self._closed, []
        for route in closed:
            self._by_route.pop(route, None)
        return closed

    def _note_closed(self, connection: PeerConnection | None) -> None:
        # Messages that it has sent may still wait to be read.
        if connection is not None:
            self._closed.append(connection.route)

    def close(self) -> None:
        """Stop watching. ZMQ must not be left waiting for a reader of its events."""
        self._read_events()
        self._router.disable_monitor()
        self._events.close(linger=0)


def _make_room() -> int:
    """Raise the process's limit of descriptors by `ROOM`; return the maximum of connections."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = soft + ROOM
    if hard != resource.RLIM_INFINITY:
        wanted = min(wanted, hard)
    if soft != resource.RLIM_INFINITY and wanted > soft:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if soft == resource.RLIM_INFINITY:
        return _MAX_CONNECTIONS
    free = soft - sum(1 for _ in Path("/dev/fd").iterdir())
    return max(8, min(_MAX_CONNECTIONS, free // 2))
