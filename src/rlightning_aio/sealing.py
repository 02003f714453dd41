"""Checksums for stored data, so that damage is found before the content is parsed.

A seal detects accidents, not attacks: an attacker can compute it too.
"""

from __future__ import annotations

import hashlib
from typing import Final

__all__ = ["seal", "unseal"]

_DIGEST: Final = hashlib.sha256


def seal(kind: bytes, content: bytes) -> bytes:
    """Prepend `kind`, a line that names the format, and a checksum to `content`."""
    return b"".join((kind, _DIGEST(content).digest(), content))


def unseal(kind: bytes, data: bytes) -> bytes:
    """Check data that `seal` returned for the same `kind`, and return its content.

    Raises:
        ValueError: `data` has another kind, or was changed or truncated.
    """
    start = len(kind) + _DIGEST().digest_size
    if not data.startswith(kind):
        raise ValueError("doesn't start like one of this version of rlightning_aio")
    if _DIGEST(data[start:]).digest() != data[len(kind) : start]:
        raise ValueError("was changed or truncated since it was made: its checksum doesn't match")
    return data[start:]
