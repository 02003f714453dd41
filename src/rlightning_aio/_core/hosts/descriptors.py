"""What the trainer waits with: a set of descriptors, and a descriptor that threads make readable.

Rule: the set is an epoll, or where the system has none (macOS) a selector with the same methods.
Both are level-triggered, and have a descriptor of their own.
"""

from __future__ import annotations

import select
import selectors
import socket
from typing import Final, cast

__all__ = ["READABLE", "WRITABLE", "WakeUp", "new_descriptor_set"]

# The numbers that epoll has; those of selectors are different.
READABLE: Final = select.POLLIN if hasattr(select, "epoll") else selectors.EVENT_READ
WRITABLE: Final = select.POLLOUT if hasattr(select, "epoll") else selectors.EVENT_WRITE


class _Selector(selectors.DefaultSelector):
    """What `selectors` offers on this system, with the methods of `select.epoll`."""

    @property
    def closed(self) -> bool:
        return self.get_map() is None  # pyright: ignore[reportUnnecessaryComparison]

    def poll(self, seconds: float) -> list[tuple[int, int]]:
        return [(key.fd, events) for key, events in self.select(None if seconds < 0 else seconds)]


def new_descriptor_set() -> select.epoll:
    """Return an empty set, or what has the same methods."""
    return select.epoll() if hasattr(select, "epoll") else cast("select.epoll", _Selector())


class WakeUp:
    """A descriptor that becomes readable when any thread says so."""

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()

    def fileno(self) -> int:
        """Return the descriptor; it is readable between `set` and `clear`."""
        return self._reader.fileno()

    def set(self) -> None:
        """Make it readable, which it is not yet."""
        self._writer.send(b"\0")

    def clear(self) -> None:
        """Make it unreadable again."""
        self._reader.recv(1)

    def close(self) -> None:
        self._reader.close()
        self._writer.close()
