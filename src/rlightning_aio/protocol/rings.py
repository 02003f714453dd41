"""Two rings of numbered entries in memory shared by a trainer and one worker.

The trainer appends requests and reads reports; the worker reads requests and appends reports. A
worker without requests marks itself as asleep and waits for its channel, where the trainer wakes
it with a few bytes. `bell` describes how workers wake the trainer.

Invariant: each word has one writer. A writer publishes (entry first, then the counter) and fences
before it checks whether the other side sleeps; a sleeper publishes that it sleeps and fences
before it checks the counter once more. So one of the two always sees the other, and no wake-up is
lost (Dekker's rule).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.exchange import (
    FRAMES_SEEN,
    FRAMES_TO_TRAINER,
    FRAMES_TO_WORKER,
    IN_ORDER,
    LINE,
    REPORTED,
    REQUESTS_SENT,
    SEEN,
    SENT,
    TAKEN,
    WORKER_ASLEEP,
    Ring,
    WorkerSide,
    new_fence,
    take,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from numpy.typing import NDArray

    from rlightning_aio.protocol.bell import TrainerBell, WorkerBell

__all__ = ["TrainerRings", "WorkerRings", "rings_size"]

# Words that `exchange` doesn't use.
_CURRENT: Final = 4 * LINE
_CURRENT_SINCE_NS: Final = 4 * LINE + 1
_WORDS: Final = 5 * LINE


def _capacity(num_envs: int) -> int:
    # Each env has at most one request in flight, so unread entries are at most as many as envs.
    return 1 << num_envs.bit_length()


def rings_size(num_envs: int) -> int:
    """Size in bytes of the words and both rings of a worker with `num_envs` envs."""
    return 8 * (_WORDS + 2 * _capacity(num_envs))


def _split(buffer: memoryview, num_envs: int) -> tuple[memoryview, memoryview, memoryview]:
    words = buffer.cast("B")[: rings_size(num_envs)].cast("q")
    capacity = _capacity(num_envs)
    return words, words[_WORDS : _WORDS + capacity], words[_WORDS + capacity :]


class TrainerRings:
    """The trainer's side: appends requests, reads reports.

    Args:
        buffer: the memory of the rings, zeroed.
        num_envs: of the worker.
        bell: of the group; index: of the worker's counter in it.
    """

    def __init__(self, buffer: memoryview, num_envs: int, bell: TrainerBell, index: int) -> None:
        self._words, requests, reports = _split(buffer, num_envs)
        self._requests: NDArray[np.int64] = np.frombuffer(requests, np.int64)
        self._reports: NDArray[np.int64] = np.frombuffer(reports, np.int64)
        self._own = memoryview(bytearray(16)).cast("q")
        self._capacity = _capacity(num_envs)
        self._mask = self._capacity - 1
        self._fence = new_fence()
        self._bell = bell
        self._index = index
        self._frames_sent = 0
        bell.restart(index)

    def ring(self, wake: Callable[[], None]) -> Ring:
        """The rings as buffers, for `exchange`."""
        return Ring(self._words, self._requests, self._reports, self._own, wake)

    def request(self, entries: NDArray[np.int64]) -> bool:
        """Append `entries` in order; True if the worker sleeps and must be rung."""
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
        """Return True if the worker must be rung to see a new entry or frame."""
        self._fence()
        return self._words[WORKER_ASLEEP] != 0

    def count_frame(self) -> bool:
        """Count a frame that was written to the channel; True if the worker must be rung."""
        self._frames_sent += 1
        self._words[FRAMES_TO_WORKER] = self._frames_sent
        return self.worker_sleeps()

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
        return self._words[_CURRENT], self._words[_CURRENT_SINCE_NS]


class WorkerRings:
    """The worker's side: reads requests, appends reports, publishes when it sleeps.

    Attributes:
        own: the worker's own counts; see `exchange`.
    """

    def __init__(self, buffer: memoryview, num_envs: int, bell: WorkerBell) -> None:
        self._words, requests, reports = _split(buffer, num_envs)
        self._reports = reports
        self._mask = _capacity(num_envs) - 1
        self._fence = new_fence()
        self._bell = bell
        self.own = bell.own
        self._side = WorkerSide(self._words, requests, reports, self.own, bell.words, bell.counter)
        self._frames_sent = 0

    def requests(self) -> list[int]:
        """Read all waiting entries, in order."""
        return take(self._side, self._fence)

    def has_frame(self) -> bool:
        """Return True if the channel has a frame that `frame_seen` has not counted."""
        return self._words[FRAMES_TO_WORKER] != self.own[FRAMES_SEEN]

    def frame_seen(self) -> None:
        """Count a frame that was read from the channel."""
        self.own[FRAMES_SEEN] += 1

    def begin(self, current: int, now_ns: int) -> None:
        """Publish the entry whose execution begins."""
        self._words[_CURRENT_SINCE_NS] = now_ns
        self._words[_CURRENT] = current

    def pause(self) -> int:
        """Publish that execution waits for the trainer. Return the argument of `resume`."""
        since_ns = self._words[_CURRENT_SINCE_NS]
        self._words[_CURRENT_SINCE_NS] = 0
        return since_ns

    def resume(self, since_ns: int) -> None:
        """Publish that execution continues, with a start time that excludes the wait."""
        self._words[_CURRENT_SINCE_NS] = since_ns

    def idle(self) -> None:
        """Publish that nothing is being executed."""
        self._words[_CURRENT] = 0

    def serve(
        self,
        execute: Callable[[int], bool],
        finish: Callable[[int, Any], object],
        ring: Callable[[], object],
        receive: Callable[[], object],
        steps: list[Callable[[], Any]],
        first_slot: int,
    ) -> bool:
        """Read waiting entries and execute them in order; see `exchange.serve`."""
        return kernel.serve(
            self._side, execute, finish, ring, receive, steps, first_slot, self._fence
        )

    def report(self, request: int, ring: Callable[[], object]) -> None:
        """Report an entry that came in a frame and whose reply is in its row; see `serve`."""
        sent = self.own[REPORTED]
        self._reports[sent & self._mask] = request
        self.own[REPORTED] = sent + 1
        if not IN_ORDER:
            self._fence()
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
        return words[REQUESTS_SENT] != own[TAKEN] or words[FRAMES_TO_WORKER] != own[FRAMES_SEEN]

    def fall_asleep(self) -> bool:
        """Publish that this worker sleeps; False if an entry or a frame has just come."""
        self._words[WORKER_ASLEEP] = 1
        self._fence()
        if self.has_news():
            self._words[WORKER_ASLEEP] = 0
            return False
        return True

    def wake_up(self) -> None:
        """Publish that this worker is awake."""
        self._words[WORKER_ASLEEP] = 0
