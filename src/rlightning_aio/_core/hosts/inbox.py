"""`Inbox`: tasks that other threads leave for the thread of the trainer."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

from rlightning_aio._core.hosts.descriptors import WakeUp

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Inbox"]


class Inbox:
    """A queue of tasks with a descriptor."""

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
