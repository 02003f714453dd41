"""`restart_pause`: the delay before a restart."""

from __future__ import annotations

from typing import Final

__all__ = ["restart_pause"]

_FIRST_SECONDS: Final = 0.1
_LONGEST_SECONDS: Final = 5.0


def restart_pause(losses: int) -> float:
    """Return the seconds to wait before the restart that follows `losses` losses in a row.

    The first restart is immediate, the second comes after a tenth of a second, and each later one
    after twice the previous pause, up to five seconds.
    """
    if losses <= 1:
        return 0.0
    return min(_FIRST_SECONDS * 2.0 ** min(losses - 2, 10), _LONGEST_SECONDS)
