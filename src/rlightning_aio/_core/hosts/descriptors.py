"""What the trainer waits with: a set of descriptors, and a descriptor that threads make readable.

Rule: the set is an epoll, or where the system has none (macOS) a selector with the same methods.
Both are level-triggered, and have a descriptor of their own.

And descriptors 0, 1 and 2: they stay open in a program that was started without its streams.
Otherwise the next file would get one of them, and output to stderr would be written into it.
"""

from __future__ import annotations

import os
import select
import selectors
import socket
import sys
import threading
from collections import deque
from typing import TYPE_CHECKING, Final, TextIO, cast

if TYPE_CHECKING:
    from collections.abc import Callable

# The numbers that epoll has; those of selectors are different.
READABLE: Final = select.POLLIN if hasattr(select, "epoll") else selectors.EVENT_READ
WRITABLE: Final = select.POLLOUT if hasattr(select, "epoll") else selectors.EVENT_WRITE
_STDOUT: Final = 1
_STDERR: Final = 2


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


class Inbox:
    """A queue of tasks that other threads leave for the trainer's, with a descriptor."""

    def __init__(self) -> None:
        self._wake_up = WakeUp()
        self._tasks: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._is_open = True

    def fileno(self) -> int:
        """Return a descriptor that is readable while there are tasks; level-triggered."""
        return self._wake_up.fileno()

    def put(self, task: Callable[[], None]) -> None:
        """Add a task, from any thread; it is dropped if the inbox is closed."""
        with self._lock:
            if self._is_open:
                if not self._tasks:
                    self._wake_up.set()
                self._tasks.append(task)

    def pop_all(self) -> list[Callable[[], None]]:
        """Remove and return all tasks, oldest first."""
        with self._lock:
            if not self._tasks:
                return []
            self._wake_up.clear()
            tasks = list(self._tasks)
            self._tasks.clear()
            return tasks

    def close(self) -> None:
        """Drop all tasks, now and later, and close the descriptor."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._tasks.clear()
                self._wake_up.close()


def occupy_standard_streams() -> None:
    """Open /dev/null in place of closed streams, here and in child processes.

    Call it before opening a file that must not get one of these descriptors.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)


def stdout_set_aside() -> TextIO:
    """Redirect descriptor 1 to stderr, here and in child processes.

    Then an env, a C library or a child process that prints can't corrupt output to stdout. Returns
    a stream to the original stdout.
    """
    occupy_standard_streams()
    before = sys.stdout
    if before is not None:  # pyright: ignore[reportUnnecessaryComparison]  # Closed by the caller.
        before.flush()
    kept = os.dup(_STDOUT)
    os.dup2(_STDERR, _STDOUT)
    return os.fdopen(
        kept,
        "w",
        encoding=getattr(before, "encoding", None),
        errors=getattr(before, "errors", None),
    )
