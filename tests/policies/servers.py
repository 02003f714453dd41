"""Policy servers as threads of the test: openpi's protocol and vla-eval's, by `websockets`.

Their codecs are written here from the protocols alone, with plain msgpack, and so are independent
of those of the clients. `test_real_servers.py` has the two projects' own servers.
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


def packed(value: Any, *, as_bytes: bool) -> bytes:
    def mapped(array: Any) -> Any:
        fields = {
            "__ndarray__": True, "data": array.tobytes(), "dtype": array.dtype.str,
            "shape": list(array.shape),
        }  # fmt: skip
        return {key.encode() if as_bytes else key: inner for key, inner in fields.items()}

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
    """Answers an observation with its chunk; keeps the observations."""

    def __init__(self) -> None:
        self.seen: list[dict[str, Any]] = []
        self.connections = 0

    def __call__(self, connection: ServerConnection) -> None:
        self.connections += 1
        connection.send(packed({"name": "stand-in"}, as_bytes=True))
        for frame in connection:
            observation = unpacked(frame)
            self.seen.append(observation)
            self.answer(connection, observation)

    def answer(self, connection: ServerConnection, observation: dict[str, Any]) -> None:
        actions = chunk_of(observation["observation/state"])
        timing = {"infer_ms": 0.5}
        connection.send(packed({"actions": actions, "server_timing": timing}, as_bytes=True))


class VlaEvalServer:
    """Answers an observation with the chunk of its session, or its next action."""

    def __init__(self, *, chunks: bool = True) -> None:
        self.chunks = chunks
        self.tasks: list[Any] = []
        self.ended = 0

    def __call__(self, connection: ServerConnection) -> None:
        steps, in_episode = 0, False
        for frame in connection:
            message = unpacked(frame)
            kind, payload, seq = message["type"], message["payload"], message["seq"]
            assert isinstance(message["timestamp"], float)
            if kind == "hello":
                self.send(connection, "hello", {"protocol_version": 1}, seq)
            elif kind == "episode_start":
                assert not in_episode
                in_episode, steps = True, 0
                self.tasks.append(payload["task"])
            elif kind == "episode_end":
                assert in_episode
                in_episode = False
                self.ended += 1
            elif kind == "observation":
                assert in_episode
                self.answer(connection, payload, seq, steps)
                steps += 1

    def answer(self, connection: ServerConnection, payload: Any, seq: int, steps: int) -> None:
        seed = payload["state"][0]
        actions = chunk_of(payload["state"])
        if not self.chunks:
            actions = np.array([seed, steps - steps % 3, steps % 3])
        self.send(connection, "action", {"actions": actions}, seq)

    def send(self, connection: ServerConnection, kind: str, payload: Any, seq: int) -> None:
        message = {"type": kind, "payload": payload, "seq": seq, "timestamp": 0.5}
        connection.send(packed(message, as_bytes=False))
