"""A TCP proxy that knows ZMTP's frames and disturbs the connections that it forwards.

At a message, a connection is cut, or falls silent without being closed (half-open), as if a cable
had been pulled. ZMTP's own commands pass, except through a silent connection.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

_GREETING_BYTES = 64
_MORE, _LONG, _COMMAND = 1, 2, 4


@dataclass(frozen=True)
class Faults:
    """Probabilities for each message."""

    cut: float = 0.0
    silence: float = 0.0


@dataclass
class _Flow:
    """One direction of one connection."""

    source: socket.socket
    sink: socket.socket
    pair: _Pair
    unread: bytearray = field(default_factory=bytearray)
    message: bytearray = field(default_factory=bytearray)
    greeting_left: int = _GREETING_BYTES

    def messages(self) -> Any:
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


@dataclass
class _Pair:
    flows: tuple[_Flow, ...] = ()
    silent: bool = False
    closed: bool = False


class FaultyProxy:
    """Forwards between clients and `target` in its own thread, with `faults`.

    Attributes:
        address: for clients.
        tally: number of messages that passed, and number for each fault.
    """

    def __init__(self, target: str, faults: Faults, seed: int = 0) -> None:
        host, _, port = target.removeprefix("tcp://").rpartition(":")
        self._target = (host, int(port))
        self.faults = faults
        self.tally = dict.fromkeys(("passed", "cut", "silence"), 0)
        self._rng = np.random.default_rng(seed)
        self._selector = selectors.DefaultSelector()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._pairs: list[_Pair] = []
        self._end, self._told = os.pipe()
        self._selector.register(self._end, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._told, b"x")
        self._thread.join()
        for pair in self._pairs:
            self._close(pair)
        self._selector.close()
        self._listener.close()
        os.close(self._end)
        os.close(self._told)

    def _run(self) -> None:
        while True:
            for key, _ in self._selector.select():
                if key.fileobj == self._end:
                    return
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read(key.data)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        try:
            server = socket.create_connection(self._target)
        except OSError:
            client.close()
            return
        pair = _Pair()
        pair.flows = (_Flow(client, server, pair), _Flow(server, client, pair))
        for flow in pair.flows:
            flow.source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._selector.register(flow.source, selectors.EVENT_READ, flow)
        self._pairs.append(pair)

    def _read(self, flow: _Flow) -> None:
        if flow.pair.closed:
            return
        try:
            data = flow.source.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            self._close(flow.pair)
            return
        if flow.pair.silent:
            return
        flow.unread += data
        for message, is_message in flow.messages():
            if flow.pair.closed or flow.pair.silent:
                return
            self._pass(flow, message) if is_message else self._send(flow, message)

    def _pass(self, flow: _Flow, message: bytes) -> None:
        self.tally["passed"] += 1
        fate = self._rng.random()
        if fate < self.faults.cut:
            self.tally["cut"] += 1
            self._close(flow.pair)
        elif fate < self.faults.cut + self.faults.silence:
            self.tally["silence"] += 1
            flow.pair.silent = True
        else:
            self._send(flow, message)

    def _send(self, flow: _Flow, message: bytes) -> None:
        if not flow.pair.closed and not flow.pair.silent:
            try:
                flow.sink.sendall(message)
            except OSError:
                self._close(flow.pair)

    def _close(self, pair: _Pair) -> None:
        if pair.closed:
            return
        pair.closed = True
        for flow in pair.flows:
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(flow.source)
            flow.source.close()
