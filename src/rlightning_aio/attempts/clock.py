"""`Clock`: seconds of an event loop, without those for which something blocked it.

While a trainer updates its weights on the loop, no attempt can run, so none should run out of time.
"""

from __future__ import annotations

import asyncio
import time
from typing import Final

_TICK: Final = 0.05


class Clock:
    """See the module. A timer ticks from `start` to `stop`; what it is late by doesn't count.

    Attributes:
        blocked: seconds that don't count; lag: those of the last tick.
    """

    def __init__(self) -> None:
        self.blocked = self.lag = 0.0
        self._due = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Begin to tick on the running loop."""
        loop = asyncio.get_running_loop()
        self._due = time.monotonic() + _TICK
        self._timer = loop.call_later(_TICK, self._tick)

    def stop(self) -> None:
        """Tick no longer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self.lag = max(time.monotonic() - self._due, 0.0)
        self.blocked += self.lag
        self.start()

    def now(self) -> float:
        """Seconds since any moment."""
        now = time.monotonic()
        late = max(now - self._due, 0.0) if self._timer is not None else 0.0
        return now - self.blocked - late
