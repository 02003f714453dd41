"""The bell of a group: how workers wake a trainer that waits for a number of results.

Shared memory holds a counter of reports for each worker, and one word that the trainer
*arms*: "ring when all counters together have come to this". The worker whose report gets them
there rings, by a few bytes in its channel. So the trainer is woken once, when there is enough,
and by nobody before.

Invariant: every word has one writer. A worker publishes its counter and fences before it
adds up everybody's; so of two that finish at the same time at least one sees the sum.
Not fenced: a worker's look at the armed word after each report, which no-work envs would feel.
While its report is on the way to memory, for a fraction of a microsecond, it may overlook a bell
that is being armed. So the trainer fences when it has armed the bell, and looks whether the goal
is `reached` a few microseconds later. A worker that has nothing left to do looks with a fence.
"""

from __future__ import annotations

import platform
import threading
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = [
    "ARMED",
    "AT_LAST",
    "IN_ORDER",
    "LINE",
    "TrainerBell",
    "WorkerBell",
    "bell_size",
    "new_fence",
]

LINE: Final = 8
"""Words of a cache line."""
IN_ORDER: Final = platform.machine() in ("x86_64", "AMD64")
"""x86 keeps loads and stores in program order, but for a load that may overtake an earlier store;
elsewhere an entry could be seen after its count, or be read before it."""

ARMED: Final = 0
_COUNTERS: Final = LINE

# The armed word is, from the lowest bit: 1, whether workers may leave it alone while they have
# something to do, the sum at which to ring, and how often counters have begun anew; 0 is disarmed.
AT_LAST: Final = 2
_GOAL_SHIFT: Final = 2
_GOAL_MASK: Final = (1 << 53) - 1
_EPOCH_SHIFT: Final = 55
_EPOCH_MASK: Final = 0x7F
_FEW: Final = 12
"""So many counters are added up sooner one by one than by NumPy."""


def new_fence() -> Callable[[], None]:
    """A fence of one thread: it releases and retakes a held lock, which orders all memory
    accesses around it.

    On x86 both are locked instructions; on ARM a store-release followed by a
    load-acquire of the same word.
    """
    lock = threading.Lock()
    lock.acquire()
    release, acquire = lock.release, lock.acquire

    def fence() -> None:
        try:  # noqa: SIM105  # `suppress` would take longer than all the rest.
            release()
        except RuntimeError:
            pass  # A Ctrl-C had struck between the two.
        acquire()

    return fence


def bell_size(num_workers: int) -> int:
    """Bytes that the bell of a group with so many workers takes."""
    return 8 * (_COUNTERS + LINE * num_workers)


def _words(buffer: memoryview, num_workers: int) -> memoryview[int]:
    return buffer.cast("B")[: bell_size(num_workers)].cast("q")


def _sum_of(words: memoryview[int]) -> Callable[[], int]:
    """A function that adds up all counters."""
    counters = words[_COUNTERS::LINE]
    if len(counters) == 1:
        return lambda: words[_COUNTERS]
    if len(counters) <= _FEW:
        return lambda: sum(counters)
    array: NDArray[np.int64] = np.frombuffer(words, np.int64)[_COUNTERS::LINE]
    return lambda: int(array.sum())


class TrainerBell:
    """The trainer's side: arms the bell, and knows what is unread.

    Args:
        buffer: the bell's memory, zeroed.
        num_workers: as many counters.
    """

    def __init__(self, buffer: memoryview, num_workers: int) -> None:
        self._fence = new_fence()
        self._epoch = 0
        self._attach(buffer, num_workers)

    def _attach(self, buffer: memoryview, num_workers: int) -> None:
        self._words = _words(buffer, num_workers)
        self._sum = _sum_of(self._words)
        self._counters = self._words[_COUNTERS::LINE]
        self._read = [0] * num_workers
        self._read_in_all = 0
        self._armed = 0

    def count(self, index: int) -> int:
        """Reports of one worker so far."""
        return self._words[_COUNTERS + LINE * index]

    def took(self, index: int, count: int) -> None:
        """Take note of reports that were read."""
        self._read[index] += count
        self._read_in_all += count

    def restart(self, index: int) -> None:
        """The worker is gone, and its replacement counts from 0.

        It leaves the bell disarmed: a call that waits must arm it anew.
        """
        self._words[_COUNTERS + LINE * index] = 0
        self.took(index, -self._read[index])
        self._epoch = (self._epoch + 1) & _EPOCH_MASK
        self.disarm()

    def unread(self) -> int:
        """Reports that wait to be read, of all workers."""
        return self._sum() - self._read_in_all

    def with_news(self) -> list[int]:
        """Workers whose reports wait to be read."""
        counts, read = self._counters.tolist(), self._read
        if counts == read:
            return []
        return [k for k, count in enumerate(counts) if count != read[k]]

    def goal(self, wanted: int) -> int:
        """What to arm for so many unread reports; the same until they are read."""
        return self._read_in_all + wanted

    def arm(self, goal: int, *, at_last: bool) -> None:
        """Have one bell rung at `goal`, once for each that is new.

        Args:
            goal: see there.
            at_last: it is reached by a worker that has nothing left to do, and nobody else need
                look.
        """
        armed = (self._epoch << _EPOCH_SHIFT) | (goal << _GOAL_SHIFT) | (AT_LAST if at_last else 0)
        if armed | 1 != self._armed:
            self._words[ARMED] = self._armed = armed | 1
            self._fence()

    def reached(self) -> bool:
        """Whether the goal for which the bell is armed is reached: somebody rings, or nobody
        need.
        """
        return self._armed != 0 and self._sum() >= (self._armed >> _GOAL_SHIFT & _GOAL_MASK)

    def disarm(self) -> None:
        """Have no bell rung: the trainer is awake."""
        if self._armed:
            self._words[ARMED] = self._armed = 0

    def release(self, seconds: float = 0.0) -> None:
        """Let go of the shared memory; what is asked of the bell from now on means nothing."""
        del seconds
        self._attach(memoryview(bytearray(8 * len(self._words))), len(self._read))

    def disown(self) -> None:
        """Let go of it in a process that was forked, whose parent goes on using it."""
        self.release()


class WorkerBell:
    """One worker's side: counts its reports, and tells when the bell is due.

    Attributes:
        words, own: the shared memory, and where its own counter lies there.
        settled: the armed word for which it has rung, or need not ring.
    """

    def __init__(self, buffer: memoryview, num_workers: int, index: int) -> None:
        self.words = _words(buffer, num_workers)
        self._sum = _sum_of(self.words)
        self.own = _COUNTERS + LINE * index
        self._fence = new_fence()
        self.settled = 0

    def publish(self, count: int) -> bool:
        """Say how many reports there are; whether it is time to ask `is_due`."""
        words = self.words
        words[self.own] = count
        armed = words[ARMED]
        return armed != self.settled and not armed & AT_LAST

    def is_due(self) -> bool:
        """Whether this worker is to ring the trainer, now; True once after each arming.

        To be asked when there is nothing left to do, too.
        """
        self._fence()
        armed = self.words[ARMED]
        if armed == self.settled:
            return False
        if armed and self._sum() < (armed >> _GOAL_SHIFT & _GOAL_MASK):
            return False
        self.settled = armed
        return armed != 0
