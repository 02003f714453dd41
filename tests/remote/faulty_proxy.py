"""A proxy that knows ZMTP's frames and disturbs the connections that it forwards.

At a message, a connection is cut, or falls silent. ZMTP's own commands pass, except through a
silent connection.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from remote.proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Iterator

    from remote.proxy import Flow, Pair

_GREETING_BYTES = 64
_MORE, _LONG, _COMMAND = 1, 2, 4


@dataclass(frozen=True)
class Faults:
    """Probabilities for each message."""

    cut: float = 0.0
    silence: float = 0.0


@dataclass
class _Stream:
    """What has arrived from one side, in frames."""

    unread: bytearray = field(default_factory=bytearray)
    message: bytearray = field(default_factory=bytearray)
    greeting_left: int = _GREETING_BYTES

    def messages(self) -> Iterator[tuple[bytes, bool]]:
        """Return the whole messages and commands that have arrived: (bytes, is it a message)."""
        # Each side sends its greeting in parts, as it receives the other's.
        if self.greeting_left:
            piece = self._taken(min(self.greeting_left, len(self.unread)))
            self.greeting_left -= len(piece)
            yield piece, False
        while (size := self._frame_size()) is not None:
            flags = self.unread[0]
            self.message += self._taken(size)
            if not flags & _MORE:
                whole, self.message = bytes(self.message), bytearray()
                yield whole, not flags & _COMMAND

    def _taken(self, size: int) -> bytes:
        taken = bytes(self.unread[:size])
        del self.unread[:size]
        return taken

    def _frame_size(self) -> int | None:
        head = 9 if self.unread and self.unread[0] & _LONG else 2
        if len(self.unread) < head:
            return None
        size = head + int.from_bytes(self.unread[1:head], "big")
        return size if len(self.unread) >= size else None


class FaultyProxy(Proxy):
    """Forwards with `faults`.

    Attributes:
        tally: number of messages that passed, and number for each fault.
    """

    def __init__(self, target: str, faults: Faults, seed: int = 0) -> None:
        super().__init__(target)
        self.faults = faults
        self.tally = dict.fromkeys(("passed", "cut", "silence"), 0)
        self._rng = np.random.default_rng(seed)
        self._streams: dict[int, _Stream] = {}

    def send(self, flow: Flow, data: bytes) -> None:
        stream = self._streams.setdefault(id(flow), _Stream())
        stream.unread += data
        for message, is_message in stream.messages():
            if is_message:
                self._disturb(flow.pair)
            if flow.pair.closed or flow.pair.silent:
                return
            super().send(flow, message)

    def _disturb(self, pair: Pair) -> None:
        self.tally["passed"] += 1
        fate = self._rng.random()
        if fate < self.faults.cut:
            self.tally["cut"] += 1
            self.close(pair)
        elif fate < self.faults.cut + self.faults.silence:
            self.tally["silence"] += 1
            pair.silent = True
