"""``strangers.py ADDRESS MESSAGES RATE SEED [curve]``: messages of those who were never let in.

They speak ZMTP by hand, so that a new connection costs them next to nothing: each sends its
greeting and, when the other end is done with its own, fifty spoilt messages at once, and hangs up.
With ``curve`` they dial a server with keys: as if it had none, or with a broken proof of a key.
They print a dot for each connection over which they have spoken.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import time

import numpy as np
from remote.random_spaces import mutation

from rlightning_aio.protocol.net.wire import Hello, Writer

BATCH = 50
"""Messages of one connection."""
GREETING = 64
"""Bytes of ZMTP's; a server without keys goes on at once, and then takes messages."""

_BOX = {"type": "box", "shape": [64 << 20], "dtype": "uint8", "low": 0, "high": 255}
_SPACES = {"type": "dict", "spaces": [["a", _BOX], ["b", {"type": "discrete", "n": 2}]]}


def hello(rng: np.random.Generator) -> list[bytes]:
    """One that is whole, but for its version."""
    return Writer().write(
        Hello(
            version=int(rng.integers(0, 3)),
            name=f"stranger-{rng.integers(100)}",
            nonce=int(rng.integers(1 << 60)),
            observation_space=_SPACES,
            action_space={"type": "discrete", "n": 2**62, "start": 2**62},
        )
    )


def spoken(rng: np.random.Generator, *, curve: bool) -> tuple[bytes, bytes]:
    """What one connection says: its greeting, and what follows the other end's."""
    is_proof = curve and bool(rng.integers(2))
    said = [_greeting(b"CURVE" if is_proof else b"NULL")]
    if is_proof:
        # A command of the right name and length, which nobody has signed.
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


def main(address: str, messages: int, rate: int, seed: int, *, curve: bool) -> None:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    rng = np.random.default_rng(seed)
    # Made beforehand: what strangers compute is no part of what they do to others.
    kept = [spoken(rng, curve=curve) for _ in range(100)]
    for k in range(messages // BATCH):
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 5) as one:
            greeting, messages_said = kept[k % len(kept)]
            one.sendall(greeting)
            heard = 0
            while heard <= GREETING and (part := one.recv(4096)):
                heard += len(part)
            one.sendall(messages_said)
            sys.stdout.write(".")
        sys.stdout.flush()
        time.sleep(BATCH / rate)


if __name__ == "__main__":
    given, *numbers = sys.argv[1:5]
    main(given, *map(int, numbers), curve="curve" in sys.argv)
