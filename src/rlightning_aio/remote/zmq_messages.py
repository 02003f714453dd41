"""Messages of several parts over a ZMQ socket, without pyzmq's overhead, and the socket's limits.

Rule: readiness is a hint. A connection can break between a poll and the read, so reading nothing is
no error. Small parts are copied, which is faster than counting references to them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

import zmq

from rlightning_aio.protocol.net.wire import HANDSHAKE_SECONDS, MAX_FRAME_BYTES, ping_ms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.protocol.net.wire import Part

_COPIED_BYTES: Final = 4096
# Plain ints: an operation on an enum costs as much as the call itself.
_LAST: Final = int(zmq.NOBLOCK)
_MORE: Final = int(zmq.NOBLOCK) | int(zmq.SNDMORE)
_EVENTS: Final = int(zmq.EVENTS)
_POLLIN: Final = int(zmq.POLLIN)


def set_limits(socket: zmq.Socket[Any], heartbeat: float) -> None:
    """Limit the size of messages, the time of handshakes, and the seconds that a peer is silent."""
    interval, patience, given_to_peer = ping_ms(heartbeat)
    socket.set(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
    socket.set(zmq.HANDSHAKE_IVL, int(1000 * HANDSHAKE_SECONDS))
    socket.set(zmq.HEARTBEAT_IVL, interval)
    socket.set(zmq.HEARTBEAT_TIMEOUT, patience)
    socket.set(zmq.HEARTBEAT_TTL, given_to_peer)


def is_readable(socket: zmq.Socket[Any]) -> bool:
    """Return True if a message may be waiting. Asking clears the socket's descriptor."""
    return cast("int", socket.get(_EVENTS)) & _POLLIN != 0


def next_frame(socket: zmq.Socket[Any]) -> zmq.Frame | None:
    """Return the first frame of the next message; None if there is none."""
    try:
        return socket.recv(_LAST, copy=False)
    except zmq.Again:
        return None


def next_message(socket: zmq.Socket[Any]) -> list[bytes] | None:
    """Return all parts of the next message; None if there is none."""
    frame = next_frame(socket)
    return None if frame is None else [bytes(part) for part in receive_parts(socket, frame)]


def send_parts(socket: zmq.Socket[Any], parts: Sequence[Part]) -> None:
    """Queue one message in ZMQ.

    Raises:
        zmq.ZMQError: the message was not queued; `zmq.Again` if the queue is full.
    """
    send, last = socket.send, len(parts) - 1
    for position, part in enumerate(parts):
        size = len(part) if type(part) is bytes else memoryview(part).nbytes
        send(part, _MORE if position < last else _LAST, copy=size < _COPIED_BYTES)


def receive_parts(socket: zmq.Socket[Any], frame: zmq.Frame) -> list[Part]:
    """Return the parts of a message from `frame` to the last."""
    parts = [_content(frame)]
    while frame.more:
        frame = socket.recv(_LAST, copy=False)
        parts.append(_content(frame))
    return parts


def _content(frame: zmq.Frame) -> Part:
    return frame.bytes if len(frame) < _COPIED_BYTES else frame.buffer.toreadonly()
