"""`Wait` and `Procedure`: how the core, which never waits, asks its driver to wait.

`GroupDriver` is what a group asks of its driver. `Scope` is a context manager that never
waits, so it serves both kinds of group.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, TypeAlias, TypeVar

from rlightning_aio._core.hosts.base import Driver
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Sized

T = TypeVar("T")
LONGEST_SECONDS: Final = 1e5


@dataclass(slots=True)
class Wait:
    """A request to block until a source is readable, or until `until` (monotonic seconds).

    It may end sooner, at the latest after `LONGEST_SECONDS`, as timers of a system can't hold every
    float. If `until` has passed, the driver polls all sources once without blocking; an
    event loop may read what has just become readable only after that.
    """

    until: float | None = None


@dataclass(slots=True, eq=False)
class Patient(Wait):
    """A request to block until a source is readable, or until some time after `until`.

    An asynchronous group keeps one timer for all such waits.
    """


TURN: Final = Wait(0.0)
"""The result is ready; let other waiting calls run first. Does nothing in a synchronous group,
where no other call can wait.
"""

Procedure: TypeAlias = Generator[Wait, float, T]
"""A generator that yields waits, receives the time after each, and returns its result.

The driver calls `Core.apply_completions` before it resumes a procedure.
"""


class GroupDriver(Driver, Protocol):
    """Waits for the sources of a group.

    Attributes:
        completions: queue of the outcomes that sources posted.
        apply_completions: applies them; the driver calls it whenever the queue isn't empty.
    """

    completions: Sized

    apply_completions: Callable[[], None]

    def check_caller(self) -> None:
        """Raise `RLightningError` if another thread uses the group, or another loop owns it."""
        ...

    def call(self, function: Callable[..., T], *args: Any) -> T:
        """Call a function of the group that doesn't wait, after `check_caller`."""
        ...

    def look(self, function: Callable[..., T], *args: Any) -> T:
        """Call a function that only looks at the group, after `check_caller`."""
        ...

    def disown(self) -> None:
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


def earliest(*times: float | None) -> float | None:
    """The earliest of the times that are not None, or None."""
    first = None
    for time in times:
        if time is not None and (first is None or time < first):
            first = time
    return first


class Scope(ABC):
    """A context manager that never waits, so it supports both kinds of ``with``."""

    @abstractmethod
    def _enter(self) -> None:
        """Enter the context."""

    @abstractmethod
    def _leave(self) -> None:
        """Leave the context, also after an error."""

    def __enter__(self) -> Self:
        self._enter()
        return self

    def __exit__(self, *error: object) -> None:
        self._leave()

    async def __aenter__(self) -> Self:
        return self.__enter__()

    async def __aexit__(self, *error: object) -> None:
        self._leave()
