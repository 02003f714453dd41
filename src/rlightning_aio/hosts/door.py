"""`Door`: watches the connections of an env_server's socket, and ends those that are of no use.

Rule: ZMQ accepts whoever comes, and tells by its monitor. Whoever then takes up room or time
without becoming a client is cut off. A client has one connection, over which it has spoken last;
others that it holds are of no use. While the trainer is away, ZMQ goes on accepting, but stops
when some thousand events wait to be read. So no flood takes more descriptors than `ROOM`, which
is added to what the process may open.
Absent on purpose: what messages mean, and who is let in.
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

from rlightning_aio.hosts.allowance import CONNECTION, price
from rlightning_aio.protocol.net.server_session import Heard
from rlightning_aio.remote.parts import is_readable

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.hosts.allowance import Allowance

__all__ = ["Connection", "Door"]

_MOST: Final = 1024
"""Connections; there are at most half as many clients."""
_UNREAD_EVENTS: Final = 1001
"""After so many ZMQ waits: a thousand of its own, and one of the reader's."""
ROOM: Final = _MOST + _UNREAD_EVENTS + 64
"""Descriptors that connections take at most; the last are for those that are being closed."""
_MOST_WASTED: Final = 32
"""Messages in a row of a connection that lead to nothing."""
_MOST_OWED: Final = 0.02
"""Seconds by which the allowance for strangers may be overdrawn before they aren't listened to."""
_CUT_REMEMBERED: Final = 4096

_ACCEPTED: Final = int(zmq.EVENT_ACCEPTED)
_DISCONNECTED: Final = int(zmq.EVENT_DISCONNECTED)
_EVENT: Final = struct.Struct("=Hi")


@dataclass(slots=True, eq=False)
class Connection:
    """One connection that has said something.

    Attributes:
        route: where messages for it go.
        descriptor: its socket's.
        user: whose key it has proved; None without keys.
        is_client: it has said something in a session.
        wasted: messages since then that led to nothing.
    """

    route: bytes
    descriptor: int
    user: str | None
    is_client: bool = False
    wasted: int = 0

    @property
    def is_strange(self) -> bool:
        """Whether nothing at all speaks for it."""
        return not self.is_client and self.user is None


class Door:
    """Counts connections and cuts off those that are of no use.

    Args:
        router: a socket that is bound to nothing yet.
        allowance: for strangers, in seconds.
        has_keys: connections have users.
        spoken_over: tells the routes over which clients speak now.

    Attributes:
        num_cut: connections that were cut off.
        num_wasted: messages that were read and led to nothing.
        num_dropped: messages that weren't read, as nobody listened any more.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        router: zmq.Socket[bytes],
        allowance: Allowance,
        *,
        has_keys: bool,
        spoken_over: Callable[[], set[bytes]],
    ) -> None:
        self.num_cut = self.num_wasted = self.num_dropped = 0
        self._allowance = allowance
        self._router = router
        self._has_keys = has_keys
        self._spoken_over = spoken_over
        self._port = -1
        self._most = _make_room()
        self._by_route: dict[bytes, Connection] = {}
        self._open: dict[int, Connection | None] = {}
        self._cut: dict[bytes, None] = {}
        name = f"inproc://door-{id(self)}"
        router.monitor(name, _ACCEPTED | _DISCONNECTED)
        self._events = context.socket(zmq.PAIR)
        self._events.set(zmq.RCVHWM, 1)
        self._events.connect(name)

    def fileno(self) -> int:
        """Tells that there is something to look at."""
        return cast("int", self._events.get(zmq.FD))

    def watch(self, port: int) -> None:
        """Connections to `port` are those that may be cut."""
        self._port = port

    @property
    def num_strangers(self) -> int:
        """Connections that have said nothing of use yet."""
        return sum(one is None or not one.is_client for one in self._open.values())

    def look(self) -> bool:
        """Take in who has come and gone, cut off those who are too many; whether any had."""
        told = self._told()
        for event, descriptor in told:
            gone = self._open.pop(descriptor, None)
            if gone is not None:
                self._by_route.pop(gone.route, None)
            if event == _ACCEPTED:
                self._open[descriptor] = None
        excess = len(self._open) - self._most
        if excess > 0:
            # Those that have been of no use the longest.
            used = self._spoken_over()
            useless = [fd for fd, one in self._open.items() if one is None or one.route not in used]
            for descriptor in useless[:excess]:
                self._close(descriptor)
        return bool(told)

    def _told(self) -> list[tuple[int, int]]:
        told: list[tuple[int, int]] = []
        # Not more than there can be at once: a flood goes on.
        while len(told) < 2 * _UNREAD_EVENTS and is_readable(self._events):
            told.append(_EVENT.unpack(self._events.recv(zmq.NOBLOCK)))
            self._events.recv(zmq.NOBLOCK)  # An address, of which the descriptor tells more.
        return told

    def connection(self, frame: zmq.Frame, now: float) -> Connection | None:
        """Whose message begins with `frame`; None if it is to be dropped."""
        found = self._speaker(frame)
        if found and found.is_strange and self._allowance.left(now) < -_MOST_OWED:
            self.cut(found)
            found = None
        self.num_dropped += found is None
        return found

    def _speaker(self, frame: zmq.Frame) -> Connection | None:
        """Whose message begins with `frame`; None for one that was cut off."""
        route = frame.bytes
        found = self._by_route.get(route)
        if found is None and route not in self._cut:
            # It may be newer than what was looked at last.
            self.look()
            user = str(frame.get("User-Id")) if self._has_keys else None
            found = Connection(route, frame.get(zmq.SRCFD), user)
            # One that is gone may have had the descriptor that is another's now.
            if self._open.get(found.descriptor, found) is None:
                self._by_route[route] = self._open[found.descriptor] = found
        return found

    def judge(self, connection: Connection, heard: Heard, num_bytes: int, now: float) -> None:
        """Take note of what a message of `num_bytes` led to."""
        if heard is Heard.IN_SESSION:
            if connection.is_strange:
                self._allowance.give_back(CONNECTION)
            connection.is_client, connection.wasted = True, 0
            return
        connection.wasted += 1
        self.num_wasted += 1
        if connection.is_strange:
            self._allowance.spend(price(num_bytes), now)
        # A client may err, where a stranger is none.
        is_nonsense = heard is Heard.MALFORMED and connection.is_strange
        if is_nonsense or connection.wasted > _MOST_WASTED:
            self.cut(connection)

    def cut(self, connection: Connection) -> None:
        """End a connection; what it has said already is to be dropped."""
        self._by_route.pop(connection.route, None)
        self._cut[connection.route] = None
        if len(self._cut) > _CUT_REMEMBERED:
            del self._cut[next(iter(self._cut))]
        if self._open.get(connection.descriptor) is connection:
            self._close(connection.descriptor)

    def _close(self, descriptor: int) -> None:
        gone = self._open.pop(descriptor)
        if gone is not None:
            self._by_route.pop(gone.route, None)
        self.num_cut += 1
        # ZMQ may have closed it by now, and somebody else opened a file in its place.
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as ours:
            if ours.getsockname()[1] == self._port and ours.type == socket.SOCK_STREAM:
                ours.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Look no more. ZMQ must not be left waiting for a reader of its events."""
        self._told()
        self._router.disable_monitor()
        self._events.close(linger=0)


def _make_room() -> int:
    """Let the process open what connections may take beside its own; how many these may be."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = soft + ROOM
    if hard != resource.RLIM_INFINITY:
        wanted = min(wanted, hard)
    if soft != resource.RLIM_INFINITY and wanted > soft:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    free = soft - sum(1 for _ in Path("/proc/self/fd").iterdir())
    return _MOST if soft == resource.RLIM_INFINITY else max(8, min(_MOST, free // 2))
