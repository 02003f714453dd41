"""What holds for a group: `Conditions`, whether anything is unlike an ordinary step; `Lifetime`,
whether it is open; `Observed`, who observes it.

The ordinary step (`steps`, `waiting`) asks one question about most that is rare: is `unusual` 0?
The component that knows of a condition sets it and clears it; while any is set, nothing is skipped.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final, Protocol

from rlightning_aio.errors import GroupClosed

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio.batch.columns import ResultColumns

CLOSED: Final = 1 << 0
"""The group is not open: before `init`, and after `close`."""
UNLIKE_ENVS: Final = 1 << 1
"""The envs are not all in workers of this machine (or in one host in this process), have different
layouts, or need more than what fits in a row."""
DEATH: Final = 1 << 2
"""A worker was replaced, or is to be, and has not shown that it works; or one is recycled now."""
LOST_EPISODE: Final = 1 << 3
"""An env lost its episode or was restored, and a result has still to show it."""
BESIDE_ROWS: Final = 1 << 4
"""A result that is ready is not, or not only, what its row holds."""
FAULT: Final = 1 << 5
"""An error waits for the collector."""
CLIENTS: Final = 1 << 6
"""A client is in session. A place that is empty sets nothing."""
OF_HOSTS: Final = ~(UNLIKE_ENVS | BESIDE_ROWS | CLIENTS)
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
        """Raise `GroupClosed` before `init` and after `close`."""
        if self.closed:
            raise GroupClosed("this group is closed; build a new one")
        if not self.open:
            raise GroupClosed(
                "this group has not been initialised; call init() first, or use it in a with block"
            )


NO_SPAN: Final = contextlib.nullcontext()
"""The span of other work while no observer is attached."""


class Observer(Protocol):
    """Receives the events of a group. Times are monotonic seconds."""

    def note_call(self, name: str, began: float) -> None:
        """Record that an operation of the core has ended that was called at `began`."""
        ...

    def note_results(self, parts: Sequence[ResultColumns]) -> None:
        """Record that results are returned as `parts`."""
        ...

    def note_hang(self, record: HostRecord) -> None:
        """Record that a worker is killed, as what it executes takes too long."""
        ...


class Observed:
    """Holds the observer of a group.

    Attributes:
        observer: None while no observer is attached.
    """

    def __init__(self) -> None:
        self.observer: Observer | None = None

    def attach(self, observer: Observer | None) -> None:
        """Report events to `observer` from now on; None detaches the current one."""
        self.observer = observer

    @contextlib.contextmanager
    def call(self, name: str, began: float) -> Generator[None]:
        """Report an operation of the core that was called at `began`, when the context ends."""
        try:
            yield
        finally:
            if self.observer is not None:
                self.observer.note_call(name, began)
