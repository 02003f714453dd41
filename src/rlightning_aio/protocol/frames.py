"""Frames: messages in the channel between a host and its local worker.

A frame is a 16-byte header (payload length, kind, an entry or another number) and a payload. `BELL`
has none, and only wakes the other side; when a worker sends it, the bell of `rings` decides.
Payloads are pickles, because both ends are processes of the same user on the same machine,
connected by an anonymous socket pair. Of what crosses a network (see `net`), only the replies of
Ray actors hold frames.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

HEADER: Final = struct.Struct("<IIq")


class FrameKind(IntEnum):
    """The kind of a frame.

    The comments name sender, number and payload; `completion_frames` has those of workers.
    """

    BELL = 0  # both
    START = 1  # trainer; 1 if the worker is a replacement: what to build
    ATTACH = 2  # trainer: offsets and sizes of the slabs, and the rows of the envs
    REQUEST = 3  # trainer; the entry: arguments out of band
    ABORT = 4  # trainer; the request's entry
    CLOSE = 5  # trainer
    RESULT = 6  # worker; the request's entry: the part out of band
    OTHER = 7  # worker; the entry of a call that has returned, else 0: any other completion


class Frame(NamedTuple):
    """One message."""

    kind: int
    number: int
    payload: bytes


def encode(kind: int, number: int = 0, payload: bytes = b"") -> bytes:
    """Encode one frame."""
    return HEADER.pack(len(payload), kind, number) + payload


BELL: Final = encode(FrameKind.BELL)
CHUNK_BYTES: Final = 1 << 16
"""Bytes to read from a channel in one call; for much larger reads the C library maps memory."""


class FrameReader:
    """Cuts a byte stream into frames; bells are dropped.

    Attributes:
        is_empty: True if no incomplete frame is buffered.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.is_empty = True

    def feed(self, data: bytes) -> list[Frame]:
        """Add `data`, and return the frames that are complete now, in order."""
        frames: list[Frame] = []
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
        self.is_empty = not buffer
        return frames
