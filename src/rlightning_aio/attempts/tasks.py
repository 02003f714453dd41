"""`TaskSource`: tasks from an iterable of either kind, read one at a time, when one is wanted."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, Iterable
from typing import TYPE_CHECKING, Any, cast

from rlightning_aio.attempts.spec import EpisodeSpec

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator


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
        self._reading: asyncio.Task[Any] | None = None
        self.is_at_end = False

    def next(self, wake: asyncio.Event) -> EpisodeSpec | None:
        """Return the next task; None if there is none yet, which sets `wake` later, or no more."""
        if self.is_at_end:
            return None
        try:
            if self._async is None:
                return spec_of_task(next(self._sync))
            if self._reading is None:
                self._reading = asyncio.ensure_future(_read(self._async))
                self._reading.add_done_callback(lambda _: wake.set())
            if not self._reading.done():
                return None
            reading, self._reading = self._reading, None
            return spec_of_task(reading.result())
        except (StopIteration, _NoMore):
            self.is_at_end = True
            return None

    def close(self) -> None:
        """End the reading."""
        self.is_at_end = True
        if self._reading is not None:
            self._reading.cancel()


class _NoMore(Exception):
    """An async iterator is at its end; a task can't raise StopAsyncIteration."""


async def _read(tasks: AsyncIterator[Any]) -> Any:
    try:
        return await anext(tasks)
    except StopAsyncIteration:
        raise _NoMore from None


def spec_of_task(task: Any) -> EpisodeSpec:
    """Return what a task that may be a tuple says."""
    if isinstance(task, tuple):
        return EpisodeSpec(*cast("tuple[Any, ...]", task))
    return task
