"""Frames: what travels in the channel between a host and its local worker.

A frame is a 16-byte header (payload length, kind, row, request number) and a payload.
A *bell* is a frame without a payload that only wakes the other side. The payload is a
pickle: both ends are the same user's own processes on the same machine, connected by
an anonymous socket pair. Nothing here ever meets a network (see `wire` for that).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

__all__ = ["BELL", "CHUNK_BYTES", "HEADER", "Frame", "FrameKind", "FrameReader", "encode"]

HEADER: Final = struct.Struct("<IHHq")


class FrameKind(IntEnum):
    """What a frame is; the comment names its sender and payload."""

    BELL = 0  # both: nothing
    START = 1  # trainer: what to build; file descriptors ride along at ATTACH
    STARTED = 2  # worker: metadata of each env
    ATTACH = 3  # trainer: layouts of the slabs whose descriptors ride along
    ATTACHED = 4  # worker: nothing
    STEP = 5  # trainer: (action or NO_ACTION, extras)
    RESET = 6  # trainer: (seed, options)
    CALL = 7  # trainer: (name, args, kwargs)
    CLOSE = 8  # trainer: nothing
    RESULT = 9  # worker: (what the row doesn't hold)
    VALUE = 10  # worker: what a CALL returned
    ERROR = 11  # worker: (type, text, traceback)
    INFO_SCHEMA = 12  # worker: a new way in which rows hold infos
    CLOSED = 13  # worker: errors of close(), by env


class Frame(NamedTuple):
    """One message."""

    kind: int
    row: int
    number: int
    payload: bytes


def encode(kind: FrameKind, row: int = 0, number: int = 0, payload: bytes = b"") -> bytes:
    """The bytes of one frame."""
    return HEADER.pack(len(payload), kind, row, number) + payload


BELL: Final = encode(FrameKind.BELL)
CHUNK_BYTES: Final = 1 << 16
"""Bytes of a channel to read at a time; the C library maps fresh memory for much more than that."""


class FrameReader:
    """Cuts a byte stream into frames; bells are dropped."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Frame]:
        """Add `data`; the frames that are complete now, in order."""
        frames: list[Frame] = []
        if data == BELL and not self._buffer:
            return frames
        self._buffer += data
        buffer, size, start = self._buffer, HEADER.size, 0
        while len(buffer) - start >= size:
            length, kind, row, number = HEADER.unpack_from(buffer, start)
            end = start + size + length
            if len(buffer) < end:
                break
            payload = bytes(memoryview(buffer)[start + size : end])
            start = end
            if kind != FrameKind.BELL:
                frames.append(Frame(kind, row, number, payload))
        del buffer[:start]
        return frames
