"""A TCP proxy whose connections can fall silent without being closed, as if a cable had been
pulled.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
from dataclasses import dataclass
from typing import Self


@dataclass
class Flow:
    """One direction of one connection."""

    source: socket.socket
    sink: socket.socket
    pair: Pair


@dataclass
class Pair:
    """A connection; nothing passes once it is `silent`."""

    flows: tuple[Flow, ...] = ()
    silent: bool = False
    closed: bool = False


class Proxy:
    """Forwards between clients and `target` in its own thread.

    Attributes:
        address: for clients.
        pairs: of each client that has connected.
    """

    def __init__(self, target: str) -> None:
        host, _, port = target.removeprefix("tcp://").rpartition(":")
        self._target = (host, int(port))
        self._selector = selectors.DefaultSelector()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._selector.register(self._listener, selectors.EVENT_READ)
        self.pairs: list[Pair] = []
        self._end, self._told = os.pipe()
        self._selector.register(self._end, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._told, b"x")
        self._thread.join()
        for pair in self.pairs:
            self.close(pair)
        self._selector.close()
        self._listener.close()
        os.close(self._end)
        os.close(self._told)

    def silence(self) -> None:
        """Let nothing pass any more."""
        for pair in self.pairs:
            pair.silent = True

    def _run(self) -> None:
        while True:
            for key, _ in self._selector.select():
                if key.fileobj == self._end:
                    return
                if key.fileobj is self._listener:
                    self._accept()
                elif not key.data.pair.closed:
                    self._read(key.data)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        try:
            server = socket.create_connection(self._target)
        except OSError:
            client.close()
            return
        pair = Pair()
        pair.flows = (Flow(client, server, pair), Flow(server, client, pair))
        for flow in pair.flows:
            flow.source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._selector.register(flow.source, selectors.EVENT_READ, flow)
        self.pairs.append(pair)

    def _read(self, flow: Flow) -> None:
        try:
            data = flow.source.recv(1 << 16)
            if data and not flow.pair.silent:
                self.send(flow, data)
        except OSError:
            data = b""
        if not data:
            self.close(flow.pair)

    def send(self, flow: Flow, data: bytes) -> None:
        """Pass data on."""
        flow.sink.sendall(data)

    def close(self, pair: Pair) -> None:
        """End a connection at both ends. Idempotent."""
        pair.closed = True
        for flow in pair.flows:
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(flow.source)
            flow.source.close()
