"""Messages between a trainer and a fork server, and the socket that carries them.

Rule: neither end waits for the other to read; messages wait here until the socket has room. A fork
server imports this module before it knows if its interpreter has the packages of a worker, so it
imports only the standard library.
Left out on purpose: the effects of the messages (see `fork_server` and `host`).
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

    from rlightning_aio._core.hosts.messages import WorkerPlace


@dataclass(frozen=True)
class Preload:
    """First message of the trainer: modules to import before the first fork."""

    path: list[str] | None
    modules: tuple[str, ...]


@dataclass(frozen=True)
class Ready:
    """First message of the fork server; `error` is the reason why it can't serve, or None."""

    error: str | None


@dataclass(frozen=True)
class Fork:
    """Fork the worker of `place`; descriptors of channel and arena travel with it."""

    place: WorkerPlace


@dataclass(frozen=True)
class Forked:
    """Worker `host_id` runs as process `pid`."""

    host_id: int
    pid: int


@dataclass(frozen=True)
class Kill:
    """Kill worker `host_id`; with `dump`, it writes its stacks to stderr first."""

    host_id: int
    dump: bool


@dataclass(frozen=True)
class CloseLimit:
    """Worker `host_id` may take so many seconds to close its envs and end, if the trainer ends."""

    host_id: int
    seconds: float


@dataclass(frozen=True)
class Exited:
    """Worker `host_id` exited, with a code (negative for a signal) and its last output."""

    host_id: int
    exit_code: int
    stderr_tail: str


@dataclass(frozen=True)
class NotForked:
    """The system did not let worker `host_id` be forked."""

    host_id: int
    why: str


Message: TypeAlias = Preload | Ready | Fork | Forked | NotForked | Kill | CloseLimit | Exited

REFUSED: Final = b"!"
"""First byte of the only packet of a fork server that can't import its code; a text follows."""
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

    Messages of any length arrive complete and in order. A message travels in packets, each with a
    mark if more packets follow.

    Args:
        end: one of a pair of SOCK_SEQPACKET sockets, which it closes.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self._waiting: deque[_Packet] = deque()
        self._begun = bytearray()

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._socket.fileno()

    @property
    def waiting(self) -> bool:
        """True while a message waits for room: call `flush` when the descriptor is writable."""
        return bool(self._waiting)

    def send(
        self, message: Message, given: socket.socket | None = None, lent: Sequence[int] = ()
    ) -> None:
        """Send `message`, now or when there is room; drop it if the other end is gone.

        Args:
            message: any message.
            given: a socket to send along; it is closed afterwards.
            lent: descriptors to send after it; they must stay open until then.
        """
        data = pickle.dumps(message)
        step = _PACKET_BYTES - 1
        last = max(len(data) - 1, 0) // step * step
        for start in range(0, last, step):
            self._waiting.append(_Packet(_MORE + data[start : start + step], None, ()))
        self._waiting.append(_Packet(_LAST + data[last:], given, lent))
        self.flush()

    def flush(self) -> None:
        """Send waiting messages as far as there is room."""
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
                self._drop()  # The other end is gone; `receive` reports that.
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
        """Return the next message; None if there is none yet.

        Raises:
            EOFError: the other end is gone, and all its messages were received.
        """
        while True:
            try:
                packet, descriptors, _, _ = socket.recv_fds(self._socket, _PACKET_BYTES * 2, 2)
            except BlockingIOError:
                return None
            except ConnectionResetError:
                continue  # It died before it read everything. Its own messages follow.
            for descriptor in descriptors:
                os.set_inheritable(descriptor, False)
            if not packet:
                raise EOFError
            if packet.startswith(REFUSED):
                return Received(Ready(packet[1:].decode(errors="replace")), [])
            self._begun += packet[1:]
            if packet.startswith(_LAST):
                message = pickle.loads(bytes(self._begun))
                self._begun.clear()
                return Received(message, descriptors)

    def close(self) -> None:
        """Close the socket, and drop waiting messages."""
        self._drop()
        self._socket.close()
