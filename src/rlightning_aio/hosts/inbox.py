"""`Inbox`: what other threads tell the trainer's, and a descriptor that says so."""

from __future__ import annotations

import os
import threading
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Inbox"]


class Inbox:
    """Tasks for the trainer's thread.

    Attributes:
        descriptor: readable while there are any; level-triggered.
    """

    def __init__(self) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._tasks: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._is_open = True

    def put(self, task: Callable[[], None]) -> None:
        """Leave a task, on any thread; dropped if nobody takes any more."""
        with self._lock:
            if self._is_open:
                if not self._tasks:
                    os.eventfd_write(self.descriptor, 1)
                self._tasks.append(task)

    def take(self) -> list[Callable[[], None]]:
        """All tasks that are there, in the order in which they came."""
        with self._lock:
            if not self._tasks:
                return []
            os.eventfd_read(self.descriptor)
            tasks = list(self._tasks)
            self._tasks.clear()
            return tasks

    def close(self) -> None:
        """Drop what is there and what will come, and give the descriptor back."""
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._tasks.clear()
                os.close(self.descriptor)
