"""`Conditions`: whether anything is unlike an ordinary step; `Lifetime`: whether a group is open.

The ordinary step (`steps`, `waiting`) asks one question about most that is rare: is `unusual` 0?
The component that knows of a condition sets it and clears it; while any is set, nothing is skipped.
"""

from __future__ import annotations

from typing import Final

from rlightning_aio.errors import GroupClosed, RLightningError

__all__ = [
    "ABORTING",
    "BESIDE_ROWS",
    "CLOSED",
    "CUT_BEFORE",
    "DEATH",
    "FAULT",
    "LOST_EPISODE",
    "OF_HOSTS",
    "PAST_END",
    "UNLIKE_ENVS",
    "Conditions",
    "Lifetime",
]

CLOSED: Final = 1 << 0
"""The group is not open: before `init`, and after `close`."""
UNLIKE_ENVS: Final = 1 << 1
"""The envs are not all in workers of this machine (or in one host in this process), have different
layouts, or need more than what fits in a row."""
DEATH: Final = 1 << 2
"""A worker was replaced and has not shown that it works, or was given up."""
LOST_EPISODE: Final = 1 << 3
"""An env lost its episode or was restored, and a result has still to show it."""
CUT_BEFORE: Final = 1 << 4
"""An env reached the step limit of an `auto_reset` context that is closed now."""
BESIDE_ROWS: Final = 1 << 5
"""A result that is ready is not, or not only, what its row holds."""
FAULT: Final = 1 << 6
"""An error waits for the collector."""
ABORTING: Final = 1 << 7
"""A request is to end without its reply."""

PAST_END: Final = 1 << 8
"""Outside `auto_reset` an env is over, of an entry that was not warned that a step would go on."""
OF_HOSTS: Final = ~(UNLIKE_ENVS | CUT_BEFORE | BESIDE_ROWS | PAST_END)
"""All that say something of hosts: while one is set, a waiting call looks at them at each turn."""


class Conditions:
    """The conditions of one group.

    Attributes:
        unusual: the sum of those that are set; 0 in an ordinary step.
    """

    __slots__ = ("unusual",)

    def __init__(self) -> None:
        self.unusual = CLOSED

    def note(self, condition: int, holds: bool) -> None:
        """Set or clear a condition."""
        self.unusual = self.unusual | condition if holds else self.unusual & ~condition


class Lifetime:
    """Whether the group is open.

    Attributes:
        open, closed: the group is initialised; it has been closed.
    """

    def __init__(self, conditions: Conditions) -> None:
        self._conditions = conditions
        self.open = False
        self.closed = False

    def begin(self) -> None:
        """Record that the group is initialised."""
        self.open = True
        self._conditions.note(CLOSED, False)

    def end(self) -> None:
        """Record that the group is closed, for good."""
        self.closed = True
        self.open = False
        self._conditions.note(CLOSED, True)

    def check_open(self) -> None:
        """Raise `RLightningError` before `init`, and `GroupClosed` after `close`."""
        if self.closed:
            raise GroupClosed("this group is closed; build a new one")
        if not self.open:
            raise RLightningError(
                "this group has not been initialised; call init() first, or use it in a with block"
            )
