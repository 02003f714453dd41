"""`RateLimiter`: the processor time that unauthenticated peers may use.

Rule: amounts are seconds of the trainer's processor. Prices are fixed instead of measured, so the
limit does not depend on what else the machine does.
"""

from __future__ import annotations

from typing import Final

from rlightning_aio.protocol.net.wire import MAX_HELLO_BYTES

__all__ = [
    "CONNECTION_COST",
    "DROPPED_FRAME_COST",
    "MAX_SAVED",
    "PEERS_SHARE",
    "RateLimiter",
    "message_cost",
]

PEERS_SHARE: Final = 0.02
"""Share of a core for all unauthenticated peers together."""
MAX_SAVED: Final = 0.05
"""Seconds that they may use at once after a quiet time."""
CONNECTION_COST: Final = 400e-6
DROPPED_FRAME_COST: Final = 5e-6
_MESSAGE_COST: Final = 50e-6
_BYTE_COST: Final = 0.5e-6


def message_cost(num_bytes: int) -> float:
    """Return the cost of reading a message. Hellos that are too long are not decoded."""
    return _MESSAGE_COST + _BYTE_COST * min(num_bytes, MAX_HELLO_BYTES)


class RateLimiter:
    """A budget that fills at a steady rate. One expense may overdraw it.

    Args:
        max_saved: upper limit of the budget.
        per_second: income.
    """

    def __init__(self, max_saved: float, per_second: float) -> None:
        self._max_saved = max_saved
        self._per_second = per_second
        self._budget = max_saved
        self._at = 0.0

    def budget(self, now: float) -> float:
        """Return the budget at `now` (monotonic seconds); negative if it was overdrawn."""
        if now > self._at:
            self._budget = min(self._max_saved, self._budget + (now - self._at) * self._per_second)
            self._at = now
        return self._budget

    def spend(self, amount: float, now: float) -> None:
        """Reduce the budget, below zero if need be."""
        self._budget = self.budget(now) - amount

    def refund(self, amount: float) -> None:
        """Return an amount that was spent on a peer that has become a client."""
        self._budget = min(self._max_saved, self._budget + amount)

    def time_of(self, amount: float, now: float) -> float:
        """Return the time at which the budget reaches `amount` if nothing is spent until then."""
        return now + max(0.0, amount - self.budget(now)) / self._per_second
