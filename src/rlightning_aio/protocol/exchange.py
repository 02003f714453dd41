"""The array functions that carry every ordinary step, and the bell that wakes a waiting trainer.

`submit`, `complete` and `gather` take and return plain arrays and buffers, so a compiled function
can replace each of them. The first two use the rings of all workers (`rings`).

The *bell* is shared memory with a counter of reports for each worker, and a word that the trainer
*arms* with a goal for the sum of the counters. The worker whose report reaches the goal rings, with
a few bytes in its channel. So the trainer is woken once, when enough results are ready.

Invariant: each shared word has one writer. A writer publishes (entry first, then the counter) and
fences before it checks whether the other side sleeps (`rings`), or sums all counters: of two
workers that finish together at least one sees the full sum.
Without a fence: a worker's read of the armed word after each report, because a fence would slow
fast envs. While the report is on its way to memory, for a fraction of a microsecond, the worker
may overlook a bell that is being armed. So the trainer fences after arming, and checks `reached`
again a few microseconds later. A worker that runs out of work checks with a fence.
Absent on purpose: decisions. The group checks requests and interprets results.
"""

from __future__ import annotations

import platform
import threading
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio.protocol.entries import (
    NUMBER_SHIFT,
    OP_BITS_ARRAY,
    SLOT_MASK_ARRAY,
    WITHOUT_OP,
    Operation,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

__all__ = [
    "ARMED",
    "AT_LAST",
    "BUSY",
    "FEW_NUMBERS",
    "FRAMES_TO_TRAINER",
    "IN_ORDER",
    "LINE",
    "REQUESTS_SENT",
    "SEEN",
    "SENT",
    "WORKER_ASLEEP",
    "Ring",
    "TrainerBell",
    "WorkerBell",
    "bell_size",
    "complete",
    "gather",
    "new_fence",
    "submit",
    "sum_of_squares",
]  # fmt: skip

LINE: Final = 8
"""Words of a cache line."""
IN_ORDER: Final = platform.machine() in ("x86_64", "AMD64")
"""x86 keeps loads and stores in program order, except that a load may overtake an earlier store.
Elsewhere a count could become visible before its entry."""

# Words of a ring, each on its own cache line to avoid false sharing.
REQUESTS_SENT: Final = 0 * LINE
WORKER_ASLEEP: Final = 1 * LINE
FRAMES_TO_TRAINER: Final = 3 * LINE
# The trainer's own counts: requests sent, and frames of the worker that were read.
SENT: Final = 0
SEEN: Final = 1

BUSY: Final = 1
"""The state of a slot whose request is in flight."""

# Words of the bell: the armed word, then the counters of the workers, each on its own line.
ARMED: Final = 0
_COUNTERS: Final = LINE

# Bits of the armed word, from the lowest: 1; 1 if only workers without further work check it; the
# sum at which to ring; and an epoch that counts restarts of workers. 0 is disarmed.
AT_LAST: Final = 2
_GOAL_SHIFT: Final = 2
_GOAL_MASK: Final = (1 << 53) - 1
_EPOCH_SHIFT: Final = 55
_EPOCH_MASK: Final = 0x7F
_FEW: Final = 12
"""Up to this number of counters, a Python sum is faster than NumPy."""
FEW_NUMBERS: Final = 8192
"""Up to this many numbers, BLAS multiplies in one thread."""

_NEXT_STEP: Final = np.array((1 << NUMBER_SHIFT) + int(Operation.STEP))


class Ring(NamedTuple):
    """The rings of one worker, as its trainer uses them.

    Attributes:
        words: shared counters and flags.
        requests, reports: shared, of a length that is a power of two.
        own: the trainer's own counts.
        wake: wakes the worker, if it sleeps.
    """

    words: memoryview[int]
    requests: NDArray[np.int64]
    reports: NDArray[np.int64]
    own: memoryview[int]
    wake: Callable[[], None]


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


def submit(
    slots: NDArray[np.intp],
    resets: NDArray[np.bool_],
    now_ns: int,
    entry: NDArray[np.int64],
    state: NDArray[np.int8],
    sent_ns: NDArray[np.int64],
    host_of: NDArray[np.int64],
    in_flight: list[int],
    rings: Sequence[Ring | None],
    fence: Callable[[], None],
) -> list[Ring]:
    """Number and publish a step for each of `slots`, all idle; return rings of sleeping workers.

    Args:
        slots: of the envs, in the order of the batch.
        resets: ``[n]``, mask of those that are reset instead.
        now_ns: time of sending.
        entry: by slot; written, like the next two.
        state: by slot.
        sent_ns: by slot.
        host_of: by slot.
        in_flight: by host, counted up.
        rings: by host.
        fence: see `new_fence`.
    """
    entries = entry[slots]
    entries &= WITHOUT_OP
    entries += _NEXT_STEP
    entries += resets  # RESET == STEP + 1
    entry[slots] = entries
    state[slots] = BUSY
    sent_ns[slots] = now_ns
    hosts = host_of[slots]
    ends: list[int] = (hosts[1:] != hosts[:-1]).nonzero()[0].tolist()
    ends.append(len(hosts) - 1)
    published: list[Ring] = []
    start = 0
    for last in ends:
        host, end = hosts.item(last), last + 1
        ring = rings[host]
        assert ring is not None
        requests, own, sent = ring.requests, ring.own, ring.own[SENT]
        at = sent & (len(requests) - 1)
        split = min(end, start + len(requests) - at)
        requests[at : at + split - start] = entries[start:split]
        if split < end:
            requests[: end - split] = entries[split:end]
        if not IN_ORDER:
            fence()
        ring.words[REQUESTS_SENT] = own[SENT] = sent + end - start
        in_flight[host] += end - start
        published.append(ring)
        start = end
    fence()
    asleep: list[Ring] = []
    for ring in published:
        if ring.words[WORKER_ASLEEP]:
            asleep.append(ring)  # noqa: PERF401  # A comprehension is a call more.
    return asleep


def complete(
    counters: memoryview[int],
    read: memoryview[int],
    entry: NDArray[np.int64],
    in_flight: list[int],
    rings: Sequence[Ring | None],
    fence: Callable[[], None],
) -> NDArray[np.intp] | None:
    """Read the reports of all workers, and compare them with the current requests.

    Args:
        counters: shared, the number of reports of each worker.
        read: by worker, the number of reports that were read, followed by their sum; counted up.
        entry: by slot.
        in_flight: by host, counted down.
        rings: by host.
        fence: see `new_fence`.

    Returns the slots whose results are in their rows; or None, without reading anything, if a
    worker has also sent frames, which come first, or if a report answers no current request.
    """
    parts: list[NDArray[np.int64]] = []
    found: list[tuple[int, int, int]] = []
    total = 0
    counts = counters.tolist()
    if not IN_ORDER:
        fence()
    for host, count in enumerate(counts):
        before = read[host]
        if count == before:
            continue
        ring = rings[host]
        if ring is None or ring.words[FRAMES_TO_TRAINER] > ring.own[SEEN]:
            return None
        reports = ring.reports
        start = before & (len(reports) - 1)
        end = start + count - before
        parts.append(reports[start:end])
        if end > len(reports):
            parts.append(reports[: end - len(reports)])
        found.append((host, count, count - before))
        total += count - before
    if len(parts) == 1:
        entries = parts[0]
    else:
        entries = np.empty(total, np.int64)
        start = 0
        for part in parts:
            entries[start : start + len(part)] = part
            start += len(part)
    slots = entries >> OP_BITS_ARRAY
    slots &= SLOT_MASK_ARRAY
    if len((entry[slots] != entries).nonzero()[0]):
        return None
    for host, count, num_read in found:
        read[host] = count
        read[-1] += num_read
        in_flight[host] -= num_read
    return slots


def gather(columns: Sequence[NDArray[Any]], rows: slice | NDArray[np.intp]) -> list[NDArray[Any]]:
    """Copy `rows` of each column."""
    found: list[NDArray[Any]] = []
    for column in columns:
        if type(rows) is slice:
            found.append(column[rows].copy())
        elif column.ndim == 1:  # For numbers, indexing is the fastest copy.
            found.append(column[rows])
        else:
            found.append(column.take(rows, axis=0))
    return found


def sum_of_squares(numbers: NDArray[Any]) -> float:
    """Return the sum of all squares: NaN, infinite or large if any number is."""
    return float(np.vdot(numbers, numbers))  # Unlike `dot`, it does not warn of an overflow.


def bell_size(num_workers: int) -> int:
    """Size in bytes of the bell of a group with `num_workers` workers."""
    return 8 * (_COUNTERS + LINE * num_workers)


def _words(buffer: memoryview, num_workers: int) -> memoryview[int]:
    return buffer.cast("B")[: bell_size(num_workers)].cast("q")


def _sum_of(words: memoryview[int]) -> Callable[[], int]:
    """Make a function that sums all counters."""
    counters = words[_COUNTERS::LINE]
    if len(counters) == 1:
        return lambda: words[_COUNTERS]
    if len(counters) <= _FEW:
        return lambda: sum(counters)
    array: NDArray[np.int64] = np.frombuffer(words, np.int64)[_COUNTERS::LINE]
    return lambda: int(array.sum())


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
        self._sum = _sum_of(self._words)
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
        return self._sum() - self.read[-1]

    def with_news(self) -> list[int]:
        """Workers with unread reports."""
        if self.counters == self.read_by_worker:
            return []
        return [k for k, count in enumerate(self.counters) if count != self.read[k]]

    def goal(self, wanted: int) -> int:
        """Goal for a number of unread reports; it stays the same until they are read."""
        return self.read[-1] + wanted

    def arm(self, goal: int, *, at_last: bool) -> None:
        """Make a worker ring once, at `goal`; repeated calls with the same goal change nothing.

        Args:
            goal: see `goal`.
            at_last: only workers without further work need to check.
        """
        armed = (self._epoch << _EPOCH_SHIFT) | (goal << _GOAL_SHIFT) | (AT_LAST if at_last else 0)
        if armed | 1 != self._armed:
            self._words[ARMED] = self._armed = armed | 1
            self._fence()

    def reached(self) -> bool:
        """Return True if the goal of the armed bell is reached, so no ring needs to be awaited."""
        return self._armed != 0 and self._sum() >= (self._armed >> _GOAL_SHIFT & _GOAL_MASK)

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
        words, own: the shared memory, and the position of its own counter there.
        settled: the armed word that needs no ring by this worker, or no further one.
    """

    def __init__(self, buffer: memoryview, num_workers: int, index: int) -> None:
        self.words = _words(buffer, num_workers)
        self._sum = _sum_of(self.words)
        self.own = _COUNTERS + LINE * index
        self._fence = new_fence()
        self.settled = 0

    def publish(self, count: int) -> bool:
        """Publish the number of reports. Return True if `is_due` must be called now."""
        words = self.words
        words[self.own] = count
        armed = words[ARMED]
        return armed != self.settled and not armed & AT_LAST

    def is_due(self) -> bool:
        """Return True, once after each arming, if this worker must ring the trainer now.

        A worker must also call this when it runs out of work.
        """
        self._fence()
        armed = self.words[ARMED]
        if armed == self.settled:
            return False
        if armed and self._sum() < (armed >> _GOAL_SHIFT & _GOAL_MASK):
            return False
        self.settled = armed
        return armed != 0
