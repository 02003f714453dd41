"""`Driver`: what a group asks of whoever waits for it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Final, Protocol

from rlightning_aio._core.hosts.base import Watcher
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Sized

__all__ = ["Driver", "forked_from", "this_process"]


class Driver(Watcher, Protocol):
    """Waits for the sources of a group.

    Attributes:
        completions: queue of the outcomes that sources posted.
        drain: applies them; the driver calls it whenever the queue isn't empty.
    """

    completions: Sized

    drain: Callable[[], None]

    def check_caller(self) -> None:
        """Raise `RLightningError` if another thread uses the group, or another loop owns it."""
        ...

    def call(self, function: Callable[..., None], *args: Any) -> None:
        """Call a function of the group that doesn't wait, after `check_caller`."""
        ...

    def forget(self) -> None:
        """Forget all sources without unregistering them, as the parent still watches them."""
        ...


this_process: Final = [os.getpid()]
"""The pid, updated in forked children; `os.getpid` would double the time of each check."""


def forked_from(pid: int) -> RLightningError:
    """The error for a call in a child forked by process `pid`."""
    return RLightningError(
        f"this group belongs to process {pid}, which has forked this one; only that process can "
        "use and close the group; build another one here"
    )
