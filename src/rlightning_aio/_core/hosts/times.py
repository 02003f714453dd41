"""Seconds that parts of the engine wait for one another.

Rule: each is derived from `GRACE` or `CLOSE` where another has to wait longer than it does. Time
limits of requests are the entry's (`limits`); what an env_server and its clients wait is in their
own modules.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable

GRACE: Final = 0.3
"""For a process of this machine to do what needs no waiting: write its stacks, or end once it was
killed."""
DUMP: Final = 3 * GRACE
"""For a worker that is late to write its stacks and to end, while others start."""
OBEY: Final = 5.0
"""For the exit of a killed worker to be reported. After that, the process that should have killed
it hangs, too. Only an overloaded machine needs a tenth of it."""
ABORT: Final = 0.2
"""For aborted requests to end by themselves. Most do, and no worker has to be killed."""

CLOSE: Final = 1.5
"""For envs to close, where their entry doesn't say. A released fork server has as long to end its
workers."""
CLOSE_ALONE: Final = CLOSE - GRACE
"""For workers to close without a trainer that has said how long."""
FILMED_CLOSE: Final = 60.0
"""For filmed envs, which write the film of the episode in progress when they close."""
CANCEL: Final = 0.4
"""For a task to end after it was cancelled."""
LATE_CANCEL: Final = CANCEL / 4
"""For one that was cancelled again."""
AWAITED_CLOSE: Final = 10.0
"""For awaitable envs to close, where their entry doesn't say."""
AWAITED_CANCEL: Final = 2 * CANCEL + LATE_CANCEL
"""What they may need beside that: requests are cancelled before envs are closed, and their tasks
after that."""

_LOOKS: Final = 4
_PAUSE: Final = 0.02


def between_looks(limits: Iterable[float]) -> float:
    """Return how often to look at requests with these time limits: a few times in the shortest."""
    return max(_PAUSE, min(limits, default=0.0) / _LOOKS)
