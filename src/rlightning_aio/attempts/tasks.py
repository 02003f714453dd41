"""`TaskSource`: tasks from an iterable of either kind, read one at a time, when one is wanted."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, Iterable
from typing import TYPE_CHECKING, Any, Final, cast

from rlightning_aio.attempts.spec import EpisodeSpec

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

_END: Final = object()


class TaskSource:
    """See the module.

    Args:
        tasks: of `EpisodeSpec`, or of tuples (task, seed) or (task, seed, options).

    Attributes:
        is_at_end: the iterable is at its end.

    Raises:
        TypeError: `tasks` is not iterable.
    """

    def __init__(self, tasks: Iterable[Any] | AsyncIterable[Any]) -> None:
        self._async: AsyncIterator[Any] | None = None
        self._sync: Iterator[Any] = iter(())
        if isinstance(tasks, AsyncIterable):
            self._async = aiter(tasks)
        else:
            self._sync = iter(tasks)
        self._reading: asyncio.Future[Any] | None = None
        self.is_at_end = False

    def next(self, wake: asyncio.Event) -> EpisodeSpec | None:
        """Return the next task; None if there is none yet, which sets `wake` later, or no more."""
        if self.is_at_end:
            return None
        if self._async is None:
            task = next(self._sync, _END)
        else:
            if self._reading is None:
                self._reading = asyncio.ensure_future(anext(self._async, _END))
                self._reading.add_done_callback(lambda _: wake.set())
            if not self._reading.done():
                return None
            reading, self._reading = self._reading, None
            task = reading.result()
        self.is_at_end = task is _END
        return None if self.is_at_end else spec_of_task(task)

    def close(self) -> None:
        """End the reading."""
        self.is_at_end = True
        if self._reading is not None:
            self._reading.cancel()


def spec_of_task(task: Any) -> EpisodeSpec:
    """Return what a task that may be a tuple says."""
    if isinstance(task, tuple):
        return EpisodeSpec(*cast("tuple[Any, ...]", task))
    return task
