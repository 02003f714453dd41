"""What a trainer and a fork server tell each other, and the socket that carries it.

Rule: neither end waits for the other one to read; messages that find no room wait in here. A fork
server imports this before it knows whether its interpreter has what workers need, so it
imports nothing but Python's own modules.
Absent on purpose: what the messages mean; that is `fork_server`'s and `process`'s.
"""

from __future__ import annotations

import errno
import os
import pickle
import socket
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.hosts.messages import WorkerPlace

__all__ = [
    "FAILED",
    "Exited",
    "Fork",
    "Forked",
    "Hello",
    "Kill",
    "Message",
    "MessageSocket",
    "Ready",
    "Received",
]


@dataclass(frozen=True)
class Hello:
    """First message of the trainer: what to import before anything is forked."""

    path: list[str] | None
    preload: tuple[str, ...]


@dataclass(frozen=True)
class Ready:
    """First message of the fork server; `error` says why it can't serve."""

    error: str | None


@dataclass(frozen=True)
class Fork:
    """Fork the worker of `place`; the channel's and the arena's descriptors ride along."""

    place: WorkerPlace


@dataclass(frozen=True)
class Forked:
    """Worker `host_id` runs as process `pid`."""

    host_id: int
    pid: int


@dataclass(frozen=True)
class Kill:
    """Kill worker `host_id`; with `dump`, have it write its stacks to stderr first."""

    host_id: int
    dump: bool


@dataclass(frozen=True)
class Exited:
    """Worker `host_id` has ended: exit code (negative for a signal), last words."""

    host_id: int
    exit_code: int
    stderr_tail: str


Message: TypeAlias = Hello | Ready | Fork | Forked | Kill | Exited

FAILED: Final = b"!"
"""Begins the one packet of a fork server that can't even import its own code: text follows."""
_MORE: Final = b"+"
_LAST: Final = b"."
_PACKET_BYTES: Final = 1 << 15
_NO_ROOM: Final = {errno.EAGAIN, errno.ENOBUFS, errno.ENOMEM, errno.ETOOMANYREFS}


class Received(NamedTuple):
    """A message, and the descriptors that came with it."""

    message: Message
    descriptors: list[int]


class _Packet(NamedTuple):
    data: bytes
    given: socket.socket | None
    lent: Sequence[int]


class MessageSocket:
    """One end of the socket between a trainer and its fork server; it never blocks.

    Messages arrive whole and in order, however long they are: each travels in packets that
    say whether more of it follows.

    Args:
        end: of a pair of SOCK_SEQPACKET sockets, which it takes.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self._waiting: deque[_Packet] = deque()
        self._begun = bytearray()

    def fileno(self) -> int:
        """Its descriptor."""
        return self._socket.fileno()

    @property
    def waiting(self) -> bool:
        """Whether something waits for room: `flush` when the descriptor is writable."""
        return bool(self._waiting)

    def send(
        self, message: Message, given: socket.socket | None = None, lent: Sequence[int] = ()
    ) -> None:
        """Send `message` as soon as there is room; what nobody reads any more is dropped.

        Args:
            message: any of them.
            given: rides along, and is closed here then.
            lent: descriptors that ride along after it, and stay open until they have.
        """
        data = pickle.dumps(message)
        step = _PACKET_BYTES - 1
        last = max(len(data) - 1, 0) // step * step
        for start in range(0, last, step):
            self._waiting.append(_Packet(_MORE + data[start : start + step], None, ()))
        self._waiting.append(_Packet(_LAST + data[last:], given, lent))
        self.flush()

    def flush(self) -> None:
        """Send what finds room now."""
        while self._waiting:
            data, given, lent = self._waiting[0]
            try:
                if given is None:
                    self._socket.send(data)
                else:
                    socket.send_fds(self._socket, [data], [given.fileno(), *lent])
            except OSError as error:
                if error.errno in _NO_ROOM:
                    return
                self._drop()  # The other end is gone; `receive` tells.
                return
            self._waiting.popleft()
            if given is not None:
                given.close()

    def _drop(self) -> None:
        while self._waiting:
            given = self._waiting.popleft().given
            if given is not None:
                given.close()

    def receive(self) -> Received | None:
        """The next message; None if none is there yet.

        Raises:
            EOFError: the other end is gone, and all that it has said was received.
        """
        while True:
            try:
                packet, descriptors, _, _ = socket.recv_fds(self._socket, _PACKET_BYTES * 2, 2)
            except BlockingIOError:
                return None
            except ConnectionResetError:
                continue  # It died with something of ours unread. What it said comes after this.
            for descriptor in descriptors:
                os.set_inheritable(descriptor, False)
            if not packet:
                raise EOFError
            if packet.startswith(FAILED):
                return Received(Ready(packet[1:].decode(errors="replace")), [])
            self._begun += packet[1:]
            if packet.startswith(_LAST):
                message = pickle.loads(bytes(self._begun))
                self._begun.clear()
                return Received(message, descriptors)

    def close(self) -> None:
        """Let go of it, and of what waits."""
        self._drop()
        self._socket.close()
