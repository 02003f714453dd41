"""`Spinner`: wait for a moment without sleeping, where that has paid lately.

Putting a process to sleep and waking it takes tens of microseconds and a system call on
the other side; a reply often comes sooner. So a process that expects one soon looks for it
a while first. It yields its core in every turn, and leaves off when others want the core
(a sleeper is woken before them, one that yields queues behind them) or when replies
have been taking longer than a spin may last.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Spinner"]

_LIMIT_SECONDS: Final = 400e-6
# A yield that nobody took takes half a microsecond.
_YIELD_SECONDS: Final = 10e-6
_SKIPPED_AFTER_CONTENTION: Final = 8
# One long pause (a policy update) says little about the next wait.
_LONGEST_COUNTED: Final = 4 * _LIMIT_SECONDS
_WEIGHT: Final = 0.1


class Spinner:
    """Decides before each wait whether to spin, from how long the last waits were."""

    def __init__(self, *, enabled: bool) -> None:
        self._enabled = enabled
        self._mean = 0.0
        self._skip = 0
        self._began = 0.0

    def spin(self, ready: Callable[[], bool]) -> bool:
        """Whether `ready` came true within a spin; if not, sleep and call `slept` after."""
        if not self._enabled:
            return False
        clock = time.monotonic
        self._began = now = clock()
        if self._skip:
            self._skip -= 1
            return False
        if self._mean > _LIMIT_SECONDS:
            return False
        until = now + _LIMIT_SECONDS
        while not ready():
            if now >= until:
                return False
            os.sched_yield()
            before, now = now, clock()
            # The one we wait for may have had the core meanwhile: then it was no loss.
            if now - before > _YIELD_SECONDS and not ready():
                self._skip = _SKIPPED_AFTER_CONTENTION
                return False
        self._note(now - self._began)
        return True

    def slept(self) -> None:
        """What was waited for has come, after a sleep."""
        if self._enabled:
            self._note(time.monotonic() - self._began)

    def _note(self, seconds: float) -> None:
        self._mean += _WEIGHT * (min(seconds, _LONGEST_COUNTED) - self._mean)
