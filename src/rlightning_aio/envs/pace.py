"""`Pace`: the control rate of envs that live in real time.

Rule: deadlines lie on a grid, so errors don't add up. A missed deadline is not made up for
by shorter periods.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Pace:
    """Deadlines at a fixed rate, on the monotonic clock.

    Args:
        hz: deadlines per second.
        clock: returns seconds.
        sleep: takes seconds.
    """

    def __init__(
        self,
        hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period = 1 / hz
        self._clock = clock
        self._sleep = sleep
        self._due = clock() + self._period

    def restart(self) -> None:
        """Set the next deadline to one period from now."""
        self._due = self._clock() + self._period

    def wait(self) -> float:
        """Sleep until the deadline, set the next one, and return the delay in seconds.

        A delay of less than a period keeps the grid; after a longer one the grid starts again.
        """
        late = self._clock() - self._due
        if late < 0:
            self._sleep(-late)
        if late < self._period:
            self._due += self._period
        else:
            self.restart()
        return max(0.0, late)
