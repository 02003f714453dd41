"""Two rings of numbered entries in memory shared by a trainer and one worker, and a group's bell.

The trainer appends requests and reads reports; the worker reads requests and appends reports. A
worker without requests marks itself as asleep and waits for its channel, where the trainer wakes
it with a few bytes.

The *bell* wakes the trainer once, when enough results are ready. It is shared memory with a counter
of reports for each worker, and a word that the trainer *arms* with a goal for the sum of the
counters. The worker whose report reaches the goal rings, with a few bytes in its channel.

Invariant: each word has one writer. A writer publishes (entry first, then the counter) and fences
before it checks whether the other side sleeps; a sleeper publishes that it sleeps and fences
before it checks the counter once more. So one of the two always sees the other, and no wake-up is
lost (Dekker's rule). In the same way a worker publishes its counter and fences before it looks at
the armed word, and the trainer arms and fences before it adds up the counters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.entries import number_of, slot_of
from rlightning_aio.protocol.exchange import (
    ARMED,
    AT_LAST,
    CURRENT,
    CURRENT_SINCE_NS,
    FRAMES_SEEN,
    FRAMES_TO_TRAINER,
    FRAMES_TO_WORKER,
    GOAL_SHIFT,
    IN_ORDER,
    LINE,
    NUM_COUNTS,
    REPORTED,
    REQUESTS_SENT,
    SEEN,
    SENT,
    SETTLED,
    TAKEN,
    WORKER_ASLEEP,
    Ring,
    WorkerSide,
    new_fence,
    take,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_WORDS: Final = 5 * LINE
_COUNTERS: Final = LINE
_EPOCH_SHIFT: Final = 55
_EPOCH_MASK: Final = 0x7F


def _capacity(num_envs: int) -> int:
    # Each env has at most one request in flight, so unread entries are at most as many as envs.
    return 1 << num_envs.bit_length()


def rings_size(num_envs: int) -> int:
    """Size in bytes of the words and both rings of a worker with `num_envs` envs."""
    return 8 * (_WORDS + 2 * _capacity(num_envs) + num_envs)


def _split(buffer: memoryview, num_envs: int) -> tuple[memoryview, memoryview, memoryview]:
    words = buffer.cast("B")[: rings_size(num_envs)].cast("q")
    capacity = _capacity(num_envs)
    reports = _WORDS + capacity
    return words, words[_WORDS:reports], words[reports : reports + capacity]


def _stops(words: memoryview[int], num_envs: int) -> memoryview[int]:
    """Return a word for each env: the request up to which it must stop whatever it moves."""
    return words[len(words) - num_envs :]


class TrainerRings:
    """The trainer's side: appends requests, reads reports.

    Args:
        buffer: the memory of the rings; it is cleared here.
        num_envs: of the worker.
        bell: of the group; index: of the worker's counter in it.
    """

    def __init__(self, buffer: memoryview, num_envs: int, bell: TrainerBell, index: int) -> None:
        self._words, requests, reports = _split(buffer, num_envs)
        self._words[:] = memoryview(bytes(8 * len(self._words))).cast("q")
        self._requests: NDArray[np.int64] = np.frombuffer(requests, np.int64)
        self._reports: NDArray[np.int64] = np.frombuffer(reports, np.int64)
        self._own = memoryview(bytearray(16)).cast("q")
        self._capacity = _capacity(num_envs)
        self._mask = self._capacity - 1
        self._fence = new_fence()
        self._bell = bell
        self._index = index
        self._frames_sent = 0
        self._stops = _stops(self._words, num_envs)
        bell.restart(index)

    def ring(self, wake: Callable[[], None]) -> Ring:
        """The rings as buffers, for `exchange`."""
        return Ring(self._words, self._requests, self._reports, self._own, wake)

    def request(self, entries: NDArray[np.int64]) -> bool:
        """Append `entries` in order; True if the worker sleeps and must be woken."""
        count, sent = len(entries), self._own[SENT]
        start = sent & self._mask
        room = self._capacity - start
        if count <= room:
            self._requests[start : start + count] = entries
        else:
            self._requests[start:] = entries[:room]
            self._requests[: count - room] = entries[room:]
        if not IN_ORDER:
            self._fence()
        self._words[REQUESTS_SENT] = self._own[SENT] = sent + count
        return self.worker_sleeps()

    def last_requests(self) -> tuple[int, ...]:
        """Entries sent last, oldest first, including all unanswered ones."""
        sent = self._own[SENT]
        start = sent & self._mask
        ring = self._requests.tolist()
        return tuple((ring[start:] + ring[:start])[-sent:] if sent else ())

    def worker_sleeps(self) -> bool:
        """Return True if the worker must be woken to see a new entry or frame."""
        self._fence()
        return self._words[WORKER_ASLEEP] != 0

    def count_frame(self) -> None:
        """Count a frame that was written to the channel, which wakes a worker that sleeps."""
        self._frames_sent += 1
        self._words[FRAMES_TO_WORKER] = self._frames_sent

    def stop(self, index: int, number: int) -> None:
        """Tell the worker to stop an env, whatever it does of the requests up to `number`."""
        self._stops[index] = number

    def reports(self) -> NDArray[np.int64]:
        """Read all unread reports, in order.

        Raises:
            RuntimeError: the worker's count is impossible.
        """
        before = self._bell.read[self._index]
        count = self._bell.counters[self._index] - before
        if not count:
            return self._reports[:0]
        if not 0 < count <= self._capacity:
            raise RuntimeError(
                f"worker {self._index} has written into memory that isn't its own: it counts "
                f"{count} unread results, of at most {self._capacity}"
            )
        if not IN_ORDER:
            self._fence()
        start = before & self._mask
        room = self._capacity - start
        if count <= room:
            found = self._reports[start : start + count].copy()
        else:
            found = np.concatenate((self._reports[start:], self._reports[: count - room]))
        if not IN_ORDER:
            self._fence()
        self._bell.took(self._index, count)
        return found

    def has_frame(self) -> bool:
        """Return True if the worker has sent a frame that `frame_seen` has not counted."""
        return self._words[FRAMES_TO_TRAINER] > self._own[SEEN]

    def frame_seen(self) -> None:
        """Count a frame that was read from the channel."""
        self._own[SEEN] += 1

    def current(self) -> tuple[int, int]:
        """Entry that the worker is executing (0 if none), and its start time.

        The time is in ns of the monotonic clock, which all processes share; 0 while the worker
        waits for the trainer to read earlier output of the entry.
        """
        current = self._words[CURRENT]
        if not IN_ORDER:
            self._fence()
        return current, self._words[CURRENT_SINCE_NS]


class WorkerRings:
    """The worker's side: reads requests, appends reports, publishes when it sleeps.

    Attributes:
        side, fence: for `kernel.serve`, which takes entries, executes and reports them.
        own: the worker's own counts; see `exchange`.
    """

    def __init__(self, buffer: memoryview, num_envs: int, bell: WorkerBell) -> None:
        self._words, requests, reports = _split(buffer, num_envs)
        self._reports = reports
        self._mask = _capacity(num_envs) - 1
        self.fence = new_fence()
        self._bell = bell
        self.own = bell.own
        self.side = WorkerSide(self._words, requests, reports, self.own, bell.words, bell.counter)
        self._frames_sent = 0
        self._stops = _stops(self._words, num_envs)
        self._stopped = [0] * num_envs

    def to_stop(self, first_slot: int, *, whatever: bool = False) -> list[int]:
        """Return the indices of the envs that must stop now.

        Those that were named since the last call, and the one that executes a request which was to
        be stopped, or `whatever` it executes.
        """
        stops, current = self._stops.tolist(), self._words[CURRENT]
        found = [k for k, number in enumerate(stops) if number != self._stopped[k]]
        self._stopped = stops
        # An env that is being built or closed has the number 0, and so has a worker that waits.
        if number := number_of(current):
            index = slot_of(current) - first_slot
            if (whatever or number <= stops[index]) and index not in found:
                found.append(index)
        return found

    def requests(self) -> list[int]:
        """Read all waiting entries, in order."""
        return take(self.side, self.fence)

    def has_frame(self) -> bool:
        """Return True if the channel has a frame that `frame_seen` has not counted."""
        return self._words[FRAMES_TO_WORKER] > self.own[FRAMES_SEEN]

    def frame_seen(self) -> None:
        """Count a frame that was read from the channel."""
        self.own[FRAMES_SEEN] += 1

    def begin(self, current: int, now_ns: int) -> None:
        """Publish that an entry is being executed which `serve` does not execute."""
        self._words[CURRENT_SINCE_NS] = now_ns
        if not IN_ORDER:
            self.fence()
        self._words[CURRENT] = current

    def pause(self) -> int:
        """Publish that execution waits for the trainer. Return the argument of `resume`."""
        since_ns = self._words[CURRENT_SINCE_NS]
        self._words[CURRENT_SINCE_NS] = 0
        return since_ns

    def resume(self, since_ns: int) -> None:
        """Publish that execution continues, with a start time that excludes the wait."""
        self._words[CURRENT_SINCE_NS] = since_ns

    def idle(self) -> None:
        """Publish that nothing is being executed."""
        self._words[CURRENT] = 0

    def report(self, request: int, ring: Callable[[], object]) -> None:
        """Report an entry whose reply is in its row, and which `serve` has not executed."""
        sent = self.own[REPORTED]
        self._reports[sent & self._mask] = request
        self.own[REPORTED] = sent + 1
        if not IN_ORDER:
            self.fence()
        self._bell.publish(sent + 1)
        if self._bell.is_due():
            ring()

    def count_frame(self) -> None:
        """Count a frame that was written to the channel."""
        self._frames_sent += 1
        self._words[FRAMES_TO_TRAINER] = self._frames_sent

    def has_news(self) -> bool:
        """Return True if an entry or a frame waits."""
        words, own = self._words, self.own
        return words[REQUESTS_SENT] != own[TAKEN] or words[FRAMES_TO_WORKER] > own[FRAMES_SEEN]

    def fall_asleep(self) -> bool:
        """Publish that this worker sleeps; False if an entry or a frame has just come."""
        self._words[WORKER_ASLEEP] = 1
        self.fence()
        if self.has_news():
            self._words[WORKER_ASLEEP] = 0
            return False
        return True

    def wake_up(self) -> None:
        """Publish that this worker is awake."""
        self._words[WORKER_ASLEEP] = 0


def bell_size(num_workers: int) -> int:
    """Size in bytes of the bell of a group with `num_workers` workers."""
    return 8 * (_COUNTERS + LINE * num_workers)


def _bell_words(buffer: memoryview, num_workers: int) -> memoryview[int]:
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
        self._words = _bell_words(buffer, num_workers)
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

    def arm(self, goal: int, *, at_last: bool) -> bool:
        """Make a worker ring once, at `goal`; repeated calls with the same goal change nothing.

        Args:
            goal: the number of reports of all workers, those included that were read.
            at_last: only workers without further work need to check.

        Returns True if the goal is reached already, so no ring needs to be awaited.
        """
        armed = (self._epoch << _EPOCH_SHIFT) | (goal << GOAL_SHIFT) | (AT_LAST if at_last else 0)
        self._armed = armed | 1
        return kernel.arm(self._words, self._armed, self._fence)

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
        self.words = _bell_words(buffer, num_workers)
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
