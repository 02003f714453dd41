"""Frames: what travels in the channel between a host and its local worker.

A frame is a 16-byte header (payload length, kind, an entry or another number) and a
payload. A *bell* is a frame without a payload that only wakes the other side. The payload
is a pickle: both ends are the same user's own processes on the same machine, connected by
an anonymous socket pair. Nothing here ever meets a network (see `net` for that).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

__all__ = ["BELL", "CHUNK_BYTES", "HEADER", "Frame", "FrameKind", "FrameReader", "encode"]

HEADER: Final = struct.Struct("<IIq")


class FrameKind(IntEnum):
    """What a frame is; the comment names its sender, its number and its payload."""

    BELL = 0  # both
    START = 1  # trainer: what to build
    STARTED = 2  # worker: what each env is like
    START_ERROR = 3  # worker; the env's index: why it could not be built
    ATTACH = 4  # trainer: layouts of the slabs, and the rows of the envs
    ATTACHED = 5  # worker
    REQUEST = 6  # trainer; its entry: arguments out of band
    RESULT = 7  # worker; the request's entry: its part out of band
    VALUE = 8  # worker; the request's entry: what a call returned
    ERROR = 9  # worker; the request's entry: an exception as text
    INFO_SCHEMA = 10  # worker; its number: a new way in which rows hold infos
    CLOSE = 11  # trainer
    CLOSED = 12  # worker: errors of close(), by env
    SAVED = 13  # worker; index of an env, and whether from before its request: where it stands


class Frame(NamedTuple):
    """One message."""

    kind: int
    number: int
    payload: bytes


def encode(kind: FrameKind, number: int = 0, payload: bytes = b"") -> bytes:
    """The bytes of one frame."""
    return HEADER.pack(len(payload), kind, number) + payload


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
            length, kind, number = HEADER.unpack_from(buffer, start)
            end = start + size + length
            if len(buffer) < end:
                break
            payload = bytes(memoryview(buffer)[start + size : end])
            start = end
            if kind != FrameKind.BELL:
                frames.append(Frame(kind, number, payload))
        del buffer[:start]
        return frames
