"""Messages of several parts over a ZMQ socket, without what pyzmq adds for other uses.

Small parts are copied, which takes less than keeping count of who still holds them.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final, cast

import zmq

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.protocol.net.wire import Part

__all__ = ["is_readable", "receive_parts", "send_parts"]

_COPIED_BYTES: Final = 4096
# Plain ints: an operation on an enum costs as much as the call itself.
_LAST: Final = int(zmq.NOBLOCK)
_MORE: Final = int(zmq.NOBLOCK) | int(zmq.SNDMORE)
_EVENTS: Final = int(zmq.EVENTS)
_POLLIN: Final = int(zmq.POLLIN)


def is_readable(socket: zmq.Socket[Any]) -> bool:
    """Whether a message can be received; asking silences the socket's descriptor until the next."""
    return cast("int", socket.get(_EVENTS)) & _POLLIN != 0


def send_parts(socket: zmq.Socket[Any], parts: Sequence[Part]) -> None:
    """Hand one message over.

    Raises:
        zmq.ZMQError: nothing was handed over; `zmq.Again` where the socket is full.
    """
    send, last = socket.send, len(parts) - 1
    for position, part in enumerate(parts):
        size = len(part) if type(part) is bytes else memoryview(part).nbytes
        send(part, _MORE if position < last else _LAST, copy=size < _COPIED_BYTES)


def receive_parts(socket: zmq.Socket[Any], frame: zmq.Frame, most: int = sys.maxsize) -> list[Part]:
    """The parts of a message from `frame`, which is its first or follows it, to the last.

    Of a message with more than `most`, the others are yet to be received.
    """
    parts = [_content(frame)]
    while frame.more and len(parts) < most:
        frame = socket.recv(_LAST, copy=False)
        parts.append(_content(frame))
    return parts


def _content(frame: zmq.Frame) -> Part:
    return frame.bytes if len(frame) < _COPIED_BYTES else frame.buffer.toreadonly()
