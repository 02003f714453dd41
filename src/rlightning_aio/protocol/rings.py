"""Two rings of numbered entries in memory shared by a trainer and one worker.

The trainer appends requests and reads reports; the worker reads requests and appends
reports. A worker that has nothing to do sleeps on its channel and is woken there by a few
bytes, which the trainer sends only when the worker has said that it sleeps. How a worker
wakes the trainer is told in `bell`.

Invariant: every word has one writer. A writer publishes (entry first, then the counter)
and fences before it looks whether the other side sleeps; a sleeper says so and fences
before it looks at the counter a last time. So one of the two always sees the other, and
no wake-up is lost (Dekker's rule).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio.protocol.bell import (
    ARMED,
    AT_LAST,
    IN_ORDER,
    LINE,
    new_fence,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.protocol.bell import TrainerBell, WorkerBell

__all__ = ["TrainerRings", "WorkerRings", "rings_size"]

# Words, each on a cache line of its own: false sharing would cost both sides.
_REQUESTS_SENT: Final = 0 * LINE
_WORKER_ASLEEP: Final = 1 * LINE
_FRAMES_TO_WORKER: Final = 2 * LINE
_FRAMES_TO_TRAINER: Final = 3 * LINE
_CURRENT: Final = 4 * LINE
_CURRENT_SINCE_NS: Final = 4 * LINE + 1
_WORDS: Final = 5 * LINE


def _capacity(num_envs: int) -> int:
    # One request of an env may be in flight, so no more entries than envs are unread.
    return 1 << num_envs.bit_length()


def rings_size(num_envs: int) -> int:
    """Bytes that the words and both rings of a worker with so many envs take."""
    return 8 * (_WORDS + 2 * _capacity(num_envs))


def _split(buffer: memoryview, num_envs: int) -> tuple[memoryview, memoryview, memoryview]:
    words = buffer.cast("B")[: rings_size(num_envs)].cast("q")
    capacity = _capacity(num_envs)
    return words, words[_WORDS : _WORDS + capacity], words[_WORDS + capacity :]


class TrainerRings:
    """The trainer's side: appends requests, reads reports.

    Args:
        buffer: the rings' memory, zeroed.
        num_envs: of the worker.
        bell: of the group; index: which of its counters is the worker's.
    """

    def __init__(self, buffer: memoryview, num_envs: int, bell: TrainerBell, index: int) -> None:
        self._words, requests, reports = _split(buffer, num_envs)
        self._requests: NDArray[np.int64] = np.frombuffer(requests, np.int64)
        self._reports: NDArray[np.int64] = np.frombuffer(reports, np.int64)
        self._capacity = _capacity(num_envs)
        self._mask = self._capacity - 1
        self._fence = new_fence()
        self._bell = bell
        self._index = index
        self._sent = 0
        self._read = 0
        self._frames_sent = 0
        bell.restart(index)

    def request(self, entries: NDArray[np.int64]) -> bool:
        """Append `entries` in order; True if the worker sleeps and must be rung."""
        count = len(entries)
        start = self._sent & self._mask
        room = self._capacity - start
        if count <= room:
            self._requests[start : start + count] = entries
        else:
            self._requests[start:] = entries[:room]
            self._requests[: count - room] = entries[room:]
        self._sent += count
        if not IN_ORDER:
            self._fence()
        self._words[_REQUESTS_SENT] = self._sent
        return self.worker_sleeps()

    def last_requests(self) -> tuple[int, ...]:
        """The entries that were sent last, oldest first; all unanswered ones are among them."""
        start = self._sent & self._mask
        ring = self._requests.tolist()
        return tuple((ring[start:] + ring[:start])[-self._sent :] if self._sent else ())

    def worker_sleeps(self) -> bool:
        """Whether the worker must be rung to see what was just published."""
        self._fence()
        return self._words[_WORKER_ASLEEP] != 0

    def count_frame(self) -> bool:
        """Tell the worker that one more frame lies in the channel; True if it must be rung.

        Call it after the frame was handed to the channel.
        """
        self._frames_sent += 1
        self._words[_FRAMES_TO_WORKER] = self._frames_sent
        return self.worker_sleeps()

    def reports(self) -> NDArray[np.int64]:
        """Read all reports there are, in order."""
        sent = self._bell.count(self._index)
        count = sent - self._read
        if not count:
            return self._reports[:0]
        if not IN_ORDER:
            self._fence()
        start = self._read & self._mask
        room = self._capacity - start
        if count <= room:
            found = self._reports[start : start + count].copy()
        else:
            found = np.concatenate((self._reports[start:], self._reports[: count - room]))
        if not IN_ORDER:
            self._fence()
        self._read = sent
        self._bell.took(self._index, count)
        return found

    def frames_from_worker(self) -> int:
        """Frames that the worker has sent so far, bells excluded."""
        return self._words[_FRAMES_TO_TRAINER]

    def current(self) -> tuple[int, int]:
        """The entry that the worker is executing (0 if none), and since when.

        The time is in ns of the monotonic clock, which all processes share; 0 while the worker
        waits for the trainer to read what has come of the entry so far.
        """
        return self._words[_CURRENT], self._words[_CURRENT_SINCE_NS]


class WorkerRings:
    """The worker's side: reads requests, appends reports, says when it sleeps."""

    def __init__(self, buffer: memoryview, num_envs: int, bell: WorkerBell) -> None:
        self._words, self._requests, self._reports = _split(buffer, num_envs)
        self._mask = _capacity(num_envs) - 1
        self._fence = new_fence()
        self._bell = bell
        self._read = 0
        self._sent = 0
        self._frames_sent = 0
        self._frames_seen = 0

    def requests(self) -> list[int]:
        """Read all entries that wait, in order."""
        sent = self._words[_REQUESTS_SENT]
        if sent == self._read:
            return []
        if not IN_ORDER:
            self._fence()
        start = self._read & self._mask
        end = start + sent - self._read
        self._read = sent
        ring = self._requests
        found = ring[start:end].tolist()
        return found if end <= len(ring) else found + ring[: end - len(ring)].tolist()

    def has_frame(self) -> bool:
        """Whether a frame lies in the channel that `frame_seen` has not counted."""
        return self._words[_FRAMES_TO_WORKER] != self._frames_seen

    def frame_seen(self) -> None:
        """Count a frame that was read from the channel."""
        self._frames_seen += 1

    def begin(self, current: int, now_ns: int) -> None:
        """Say which entry is being executed."""
        self._words[_CURRENT_SINCE_NS] = now_ns
        self._words[_CURRENT] = current

    def pause(self) -> int:
        """Say that what is being executed waits for the trainer; what `resume` takes."""
        since_ns = self._words[_CURRENT_SINCE_NS]
        self._words[_CURRENT_SINCE_NS] = 0
        return since_ns

    def resume(self, since_ns: int) -> None:
        """Say that it goes on, and since when it would have been executed without the wait."""
        self._words[_CURRENT_SINCE_NS] = since_ns

    def idle(self) -> None:
        """Say that nothing is being executed."""
        self._words[_CURRENT] = 0

    def serve(self, execute: Callable[[int], bool], ring: Callable[[], object]) -> bool:
        """Read the entries that wait and execute them in order; False if there were none.

        Args:
            execute: takes an entry; returns whether it is done and to be reported here.
            ring: wakes the trainer; called when the group's bell is due.
        """
        requests = self.requests()
        if not requests:
            return False
        reports, mask, bell, words = self._reports, self._mask, self._bell, self._bell.words
        own = bell.own
        for request in requests:
            if not execute(request):
                continue
            reports[self._sent & mask] = request
            self._sent = sent = self._sent + 1
            if not IN_ORDER:
                self._fence()
            # `WorkerBell.publish`, spelt out: it would be felt in every step.
            words[own] = sent
            armed = words[ARMED]
            if armed != bell.settled and not armed & AT_LAST and bell.is_due():
                ring()
        if bell.is_due():
            ring()
        return True

    def report(self, request: int, ring: Callable[[], object]) -> None:
        """Report an entry that came in a frame and whose reply is all in its row; see `serve`."""
        self._reports[self._sent & self._mask] = request
        self._sent += 1
        if not IN_ORDER:
            self._fence()
        self._bell.publish(self._sent)
        if self._bell.is_due():
            ring()

    def count_frame(self) -> None:
        """Say that one more frame was handed to the channel."""
        self._frames_sent += 1
        self._words[_FRAMES_TO_TRAINER] = self._frames_sent

    def has_news(self) -> bool:
        """Whether an entry or a frame waits."""
        words = self._words
        return words[_REQUESTS_SENT] != self._read or words[_FRAMES_TO_WORKER] != self._frames_seen

    def fall_asleep(self) -> bool:
        """Say that this worker sleeps; False if something came meanwhile."""
        self._words[_WORKER_ASLEEP] = 1
        self._fence()
        if self.has_news():
            self._words[_WORKER_ASLEEP] = 0
            return False
        return True

    def wake_up(self) -> None:
        """Say that this worker is awake."""
        self._words[_WORKER_ASLEEP] = 0
