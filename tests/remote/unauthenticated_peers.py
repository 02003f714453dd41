"""``unauthenticated_peers.py ADDRESS MESSAGES [curve]``: sends corrupted messages.

It implements ZMTP itself, so that a new connection costs it next to nothing. Each connection sends
its greeting and, after that of the other end, fifty corrupted messages at once, and hangs up. With
``curve`` it dials a server with keys: without keys, or with an invalid proof of a key.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys

import numpy as np
from remote.random_spaces import mutation

from rlightning_aio.protocol.net.wire import ClientHello, Writer

BATCH = 50
"""Messages of one connection."""
GREETING = 64
"""Bytes of ZMTP's; a server without keys continues at once, and then accepts messages."""

_BOX = {"type": "box", "shape": [64 << 20], "dtype": "uint8", "low": 0, "high": 255}
_SPACES = {"type": "dict", "spaces": [["a", _BOX], ["b", {"type": "discrete", "n": 2}]]}


def hello(rng: np.random.Generator) -> list[bytes]:
    """Return a hello that is valid but for its version."""
    return Writer().write(
        ClientHello(
            version=int(rng.integers(0, 3)),
            name=f"peer-{rng.integers(100)}",
            observation_space=_SPACES,
            action_space={"type": "discrete", "n": 2**62, "start": 2**62},
        )
    )


def spoken(rng: np.random.Generator, *, curve: bool) -> tuple[bytes, bytes]:
    """Return the bytes of one connection: its greeting, and those after the other end's."""
    is_proof = curve and bool(rng.integers(2))
    said = [_greeting(b"CURVE" if is_proof else b"NULL")]
    if is_proof:
        # A command with the right name and length and an invalid signature.
        said.append(_frame(b"\x05HELLO\x01\x00" + rng.bytes(192), 4))
    else:
        said.append(_frame(b"\x05READY\x0bSocket-Type" + struct.pack(">I", 6) + b"DEALER", 4))
    messages: list[bytes] = []
    for _ in range(BATCH):
        *others, last = mutation(rng)(hello(rng)) or [b""]
        messages += [*(_frame(part, 1) for part in others), _frame(last, 0)]
    return b"".join(said), b"".join(messages)


def _greeting(mechanism: bytes) -> bytes:
    return b"\xff" + bytes(7) + b"\x01\x7f\x03\x01" + mechanism.ljust(20, b"\0") + bytes(32)


def _frame(content: bytes, flags: int) -> bytes:
    if len(content) < 256:
        return bytes([flags, len(content)]) + content
    return struct.pack(">BQ", flags | 2, len(content)) + content


def main(address: str, messages: int, *, curve: bool) -> None:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    rng = np.random.default_rng(0)
    kept = [spoken(rng, curve=curve) for _ in range(100)]
    for k in range(messages // BATCH):
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 5) as one:
            greeting, messages_said = kept[k % len(kept)]
            one.sendall(greeting)
            heard = 0
            while heard <= GREETING and (part := one.recv(4096)):
                heard += len(part)
            one.sendall(messages_said)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), curve="curve" in sys.argv)
