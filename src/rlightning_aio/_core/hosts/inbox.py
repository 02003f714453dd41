"""`Inbox`: tasks that other threads leave for the thread of the trainer."""

from __future__ import annotations

import os
import threading
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Inbox"]


class Inbox:
    """A queue of tasks with a descriptor.

    Attributes:
        descriptor: readable while there are tasks; level-triggered.
    """

    def __init__(self) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._tasks: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._is_open = True

    def put(self, task: Callable[[], None]) -> None:
        """Add a task, from any thread; it is dropped if the inbox is closed."""
        with self._lock:
            if self._is_open:
                if not self._tasks:
                    os.eventfd_write(self.descriptor, 1)
                self._tasks.append(task)

    def take(self) -> list[Callable[[], None]]:
        """Remove and return all tasks, oldest first."""
        with self._lock:
            if not self._tasks:
                return []
            os.eventfd_read(self.descriptor)
            tasks = list(self._tasks)
            self._tasks.clear()
            return tasks

    def close(self) -> None:
        """Drop all tasks, now and later, and close the descriptor."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._tasks.clear()
                os.close(self.descriptor)
