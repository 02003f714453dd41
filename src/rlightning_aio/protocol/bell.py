"""The bell: wakes the trainer once, when enough results are ready.

It is shared memory with a counter of reports for each worker, and a word that the trainer *arms*
with a goal for the sum of the counters. The worker whose report reaches the goal rings, with a few
bytes in its channel.

Invariant: a worker publishes its counter and fences before it looks at the armed word; the trainer
arms and fences before it adds up the counters. So the goal is seen by one of them at least, and of
two workers that finish together at least one sees the full sum.
"""

from __future__ import annotations

from typing import Final

from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.exchange import (
    ARMED,
    AT_LAST,
    GOAL_MASK,
    GOAL_SHIFT,
    LINE,
    NUM_COUNTS,
    SETTLED,
    new_fence,
)

__all__ = ["TrainerBell", "WorkerBell", "bell_size"]

_COUNTERS: Final = LINE
_EPOCH_SHIFT: Final = 55
_EPOCH_MASK: Final = 0x7F


def bell_size(num_workers: int) -> int:
    """Size in bytes of the bell of a group with `num_workers` workers."""
    return 8 * (_COUNTERS + LINE * num_workers)


def _words(buffer: memoryview, num_workers: int) -> memoryview[int]:
    return buffer.cast("B")[: bell_size(num_workers)].cast("q")


class TrainerBell:
    """The trainer's side: arms the bell, and counts unread reports.

    Args:
        buffer: the bell's memory, zeroed.
        num_workers: number of counters.

    Attributes:
        counters: shared, the number of reports of each worker.
        read: the number of reports of each worker that were read, followed by their sum;
            read_by_worker: without the sum.
    """

    def __init__(self, buffer: memoryview, num_workers: int) -> None:
        self._fence = new_fence()
        self._epoch = 0
        self._attach(buffer, num_workers)

    def _attach(self, buffer: memoryview, num_workers: int) -> None:
        self._words = _words(buffer, num_workers)
        self.counters = self._words[_COUNTERS::LINE]
        self.read = memoryview(bytearray(8 * (num_workers + 1))).cast("q")
        self.read_by_worker = self.read[:num_workers]
        self._armed = 0

    def took(self, index: int, count: int) -> None:
        """Record that `count` reports of a worker were read."""
        self.read[index] += count
        self.read[-1] += count

    def restart(self, index: int) -> None:
        """Reset the counter of a worker that is replaced, and disarm the bell.

        A call that waits must arm it again.
        """
        self._words[_COUNTERS + LINE * index] = 0
        self.took(index, -self.read[index])
        self._epoch = (self._epoch + 1) & _EPOCH_MASK
        self.disarm()

    def unread(self) -> int:
        """Number of unread reports of all workers."""
        return sum(self.counters) - self.read[-1]

    def with_news(self) -> list[int]:
        """Workers with unread reports."""
        if self.counters == self.read_by_worker:
            return []
        return [k for k, count in enumerate(self.counters) if count != self.read[k]]

    def goal(self, wanted: int) -> int:
        """Goal for a number of unread reports; it stays the same until they are read."""
        return self.read[-1] + wanted

    def arm(self, goal: int, *, at_last: bool) -> bool:
        """Make a worker ring once, at `goal`; repeated calls with the same goal change nothing.

        Args:
            goal: see `goal`.
            at_last: only workers without further work need to check.

        Returns True if the goal is reached already; see `reached`.
        """
        armed = (self._epoch << _EPOCH_SHIFT) | (goal << GOAL_SHIFT) | (AT_LAST if at_last else 0)
        self._armed = armed | 1
        return kernel.arm(self._words, self._armed, self._fence)

    def reached(self) -> bool:
        """Return True if the goal of the armed bell is reached, so no ring needs to be awaited."""
        return self._armed != 0 and sum(self.counters) >= (self._armed >> GOAL_SHIFT & GOAL_MASK)

    def disarm(self) -> None:
        """Prevent rings while the trainer is awake."""
        if self._armed:
            self._words[ARMED] = self._armed = 0

    def release(self, seconds: float = 0.0) -> None:
        """Release the shared memory; later answers of the bell are meaningless."""
        del seconds
        self._attach(memoryview(bytearray(8 * len(self._words))), len(self.read_by_worker))

    def disown(self) -> None:
        """Release the shared memory in a forked process; the parent continues to use it."""
        self.release()


class WorkerBell:
    """The worker's side: counts its reports, and decides when to ring.

    Attributes:
        words, counter: the shared memory, and the position of its own counter there.
        own: the worker's own counts; see `exchange`.
    """

    def __init__(self, buffer: memoryview, num_workers: int, index: int) -> None:
        self.words = _words(buffer, num_workers)
        self.counter = _COUNTERS + LINE * index
        self.own = memoryview(bytearray(8 * NUM_COUNTS)).cast("q")
        self._fence = new_fence()

    def publish(self, count: int) -> bool:
        """Publish the number of reports. Return True if `is_due` must be called now."""
        words = self.words
        words[self.counter] = count
        self._fence()
        armed = words[ARMED]
        return armed != self.own[SETTLED] and not armed & AT_LAST

    def is_due(self) -> bool:
        """Return True, once after each arming, if this worker must ring the trainer now.

        A worker must also call this when it runs out of work.
        """
        return kernel.is_due(self.words, self.own, self._fence)
