"""What adapters to other interfaces need of a group: calls in two halves, and which resets are due.

Users have `group.call`, which sends and waits. Left out: which methods envs have.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rlightning_aio._core.group.api.facade import check_seconds

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.sync import EnvGroup

__all__ = ["collect_calls", "due_for_reset", "send_calls"]


def send_calls(
    group: Any, name: str, /, *args: Any, env_ids: Sequence[str] | None = None, **kwargs: Any
) -> None:
    """Send what `group.call` sends, without waiting; errors are those before anything is sent."""
    calls = group._core.calls  # noqa: SLF001
    group._driver.call(calls.send_calls, time.monotonic(), env_ids, (name, args, kwargs))  # noqa: SLF001


def collect_calls(group: Any, deadline: float | None = None) -> Any:
    """Wait for the values of all calls that `send_calls` has sent.

    Args:
        group: of an asynchronous group, the answer is to be awaited.
        deadline: limit in seconds, from now.

    Returns the values in the order in which the calls were sent. Cancelled, it loses none.

    Raises:
        NothingPending: no call is outstanding.
        TimeoutError: `deadline` has passed; the next `collect_calls` gets the values.
        EnvRaised, WorkerDied, EnvHung, GroupClosed: as of `group.call`.
        RLightningError: another call is collecting values.
    """
    check_seconds("deadline", deadline)
    calls = group._core.calls  # noqa: SLF001
    return group._driver.run(calls.collect_calls(time.monotonic(), deadline))  # noqa: SLF001


def due_for_reset(group: EnvGroup) -> NDArray[np.bool_]:
    """Return for each env whether its next step is a reset, while `auto_reset` is open."""
    return group._core.tables.continuity.due.copy()  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
