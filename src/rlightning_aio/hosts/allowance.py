"""`Allowance`: what may be spent on strangers, as time goes by.

Rule: amounts are seconds of the trainer's processor, at fixed prices instead of measured ones, so
what strangers may do doesn't depend on what else the machine does.
"""

from __future__ import annotations

from typing import Final

from rlightning_aio.protocol.net.wire import MAX_HELLO_BYTES

__all__ = ["CONNECTION", "DROPPED_FRAME", "SAVED", "STRANGERS_SHARE", "Allowance", "price"]

STRANGERS_SHARE: Final = 0.02
"""Of a core, for all strangers together."""
SAVED: Final = 0.05
"""That strangers may take at once, when none came for a while."""
CONNECTION: Final = 400e-6
DROPPED_FRAME: Final = 5e-6
_MESSAGE: Final = 50e-6
_BYTE: Final = 0.5e-6


def price(num_bytes: int) -> float:
    """Of finding out what a message says; nobody looks into a hello that is too long."""
    return _MESSAGE + _BYTE * min(num_bytes, MAX_HELLO_BYTES)


class Allowance:
    """Fills up at a steady rate; may be overdrawn by a single expense.

    Args:
        most: that can be saved.
        per_second: that comes in.
    """

    def __init__(self, most: float, per_second: float) -> None:
        self._most = most
        self._per_second = per_second
        self._left = most
        self._at = 0.0

    def left(self, now: float) -> float:
        """What may be spent at `now` (monotonic seconds); below 0 if it was overdrawn."""
        if now > self._at:
            self._left = min(self._most, self._left + (now - self._at) * self._per_second)
            self._at = now
        return self._left

    def spend(self, amount: float, now: float) -> None:
        """It is gone, whether it was there or not."""
        self._left = self.left(now) - amount

    def give_back(self, amount: float) -> None:
        """It was spent on somebody who turned out to be no stranger."""
        self._left = min(self._most, self._left + amount)

    def time_of(self, amount: float, now: float) -> float:
        """When there will be `amount`, if nothing is spent until then."""
        return now + max(0.0, amount - self.left(now)) / self._per_second
