"""A policy server as a thread of the test: openpi's protocol, by `websockets`.

Its codec is written here from the protocol alone, with plain msgpack, and so is independent of
that of the client. `test_real_servers.py` has openpi's own.
"""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from policies.counting import chunk_of
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from websockets.sync.server import ServerConnection


def packed(value: Any) -> bytes:
    def mapped(array: Any) -> Any:
        return {
            b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str,
            b"shape": list(array.shape),
        }  # fmt: skip

    return msgspec.msgpack.encode(value, enc_hook=mapped)


def unpacked(frame: Any) -> Any:
    def read(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        fields = {key.decode() if isinstance(key, bytes) else key: v for key, v in value.items()}
        if "__ndarray__" in fields:
            return np.frombuffer(fields["data"], fields["dtype"]).reshape(fields["shape"])
        return {key: read(inner) for key, inner in fields.items()}

    return read(msgspec.msgpack.decode(frame))


@contextlib.contextmanager
def serving(handler: Callable[[ServerConnection], None], port: int = 0) -> Iterator[str]:
    """Serve in threads, and yield the URL."""

    def handled(connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            handler(connection)

    with serve(handled, "127.0.0.1", port, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


class OpenPiServer:
    """Answers an observation with its chunk, or as `answer` does; keeps the observations."""

    def __init__(self, answer: Callable[[ServerConnection, Any], None] | None = None) -> None:
        self.seen: list[dict[str, Any]] = []
        self.connections = 0
        self._answer = answer or send_chunk

    def __call__(self, connection: ServerConnection) -> None:
        self.connections += 1
        connection.send(packed({"name": "stand-in"}))
        for frame in connection:
            observation = unpacked(frame)
            self.seen.append(observation)
            self._answer(connection, observation)


def send_chunk(connection: ServerConnection, observation: dict[str, Any]) -> None:
    """Answer as a server of openpi does."""
    actions = chunk_of(observation["observation/state"])
    timing = {"infer_ms": 0.5}
    connection.send(packed({"actions": actions, "server_timing": timing}))
