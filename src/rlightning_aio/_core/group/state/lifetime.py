"""`Lifetime`: whether a group is open."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio._core.group.state.conditions import CLOSED
from rlightning_aio.errors import GroupClosed, RLightningError

if TYPE_CHECKING:
    from rlightning_aio._core.group.state.conditions import Conditions

__all__ = ["Lifetime"]


class Lifetime:
    """See the module.

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
