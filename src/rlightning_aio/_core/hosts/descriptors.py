"""What the trainer waits with: a set of descriptors, and a descriptor that threads make readable.

Rule: the set is an epoll, or where the system has none (macOS) a kqueue with the same methods. Both
are level-triggered, and have a descriptor of their own.
"""

from __future__ import annotations

import select
import socket
from typing import Any, Final, cast

__all__ = ["READABLE", "WRITABLE", "WakeUp", "new_descriptor_set"]

READABLE: Final = select.POLLIN  # The numbers of epoll, too.
WRITABLE: Final = select.POLLOUT
_MAX_EVENTS: Final = 64


class _Kqueue:
    """A kqueue with the methods of `select.epoll`."""

    def __init__(self) -> None:
        # Known to type checkers on systems that have it.
        self._system: Any = select
        self._kqueue = self._system.kqueue()
        self._masks: dict[int, int] = {}

    @property
    def closed(self) -> bool:
        return self._kqueue.closed

    def fileno(self) -> int:
        return self._kqueue.fileno()

    def close(self) -> None:
        self._kqueue.close()

    def register(self, descriptor: int, mask: int) -> None:
        self._masks[descriptor] = 0
        self.modify(descriptor, mask)

    def unregister(self, descriptor: int) -> None:
        self.modify(descriptor, 0)
        del self._masks[descriptor]

    def modify(self, descriptor: int, mask: int) -> None:
        system = self._system
        changed = self._masks[descriptor] ^ mask
        for bit, kind in (READABLE, system.KQ_FILTER_READ), (WRITABLE, system.KQ_FILTER_WRITE):
            if changed & bit:
                action = system.KQ_EV_ADD if mask & bit else system.KQ_EV_DELETE
                self._kqueue.control([system.kevent(descriptor, kind, action)], 0, 0)
        self._masks[descriptor] = mask

    def poll(self, seconds: float) -> list[tuple[int, int]]:
        found = self._kqueue.control(None, _MAX_EVENTS, None if seconds < 0 else seconds)
        reads = self._system.KQ_FILTER_READ
        return [(event.ident, READABLE if event.filter == reads else WRITABLE) for event in found]


def new_descriptor_set() -> select.epoll:
    """Return an empty set, or what has the same methods."""
    return select.epoll() if hasattr(select, "epoll") else cast("select.epoll", _Kqueue())


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
