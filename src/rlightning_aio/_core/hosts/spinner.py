"""`Spinner`: waits briefly without sleeping, if recent waits were short.

A sleep and a wake-up take tens of microseconds and a system call on the other side; a reply often
comes sooner. So a process first polls for a while. It yields its core in each turn. It stops when
other processes want the core (a sleeper is woken before them, but one that yields queues behind
them), or when recent replies took longer than a spin may last.
"""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

_LIMIT_SECONDS: Final = 400e-6
# A yield takes half a microsecond if no other process wants the core.
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
        """Spin until `ready` returns True; if this returns False, sleep and then call `slept`."""
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
            # If the awaited process had the core, yielding was right.
            if now - before > _YIELD_SECONDS and not ready():
                self._skip = _SKIPPED_AFTER_CONTENTION
                return False
        self._note(now - self._began)
        return True

    def slept(self) -> None:
        """Record that the wait ended after a sleep."""
        if self._enabled:
            self._note(time.monotonic() - self._began)

    def _note(self, seconds: float) -> None:
        self._mean += _WEIGHT * (min(seconds, _LONGEST_COUNTED) - self._mean)
