"""Two rings of numbered entries in memory shared by a trainer and one worker.

The trainer appends requests and reads reports; the worker reads requests and appends
reports. Each side sleeps on the channel; a *bell* (see `frames`) wakes it, and is
rung only when the other side has said that it sleeps.

Invariant: every word has one writer. A writer publishes (entry first, then the
counter) and fences before it looks whether the other side sleeps; a sleeper says so
and fences before it looks at the counter a last time. So one of the two always sees
the other, and no wake-up is lost (Dekker's rule).
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
    "NUMBER_SHIFT",
    "OP_BITS",
    "OP_MASK",
    "RESET",
    "SLOT_MASK",
    "STEP",
    "TrainerRings",
    "WorkerRings",
    "entry",
    "number_of",
    "op_of",
    "rings_size",
    "slot_of",
]

# An entry is one int64: request number, slot of the env in its group, operation.
OP_BITS: Final = 8
SLOT_BITS: Final = 20
NUMBER_SHIFT: Final = OP_BITS + SLOT_BITS
SLOT_MASK: Final = (1 << SLOT_BITS) - 1
OP_MASK: Final = (1 << OP_BITS) - 1

# Invariant: RESET == STEP + 1, so that a batch of steps becomes resets by adding a mask.
STEP: Final = 1
RESET: Final = 2

# Words, each on a cache line of its own: false sharing would cost both sides.
_LINE: Final = 8
_REQUESTS_SENT: Final = 0 * _LINE
_REPORTS_SENT: Final = 1 * _LINE
_REPORTS_READ: Final = 2 * _LINE
_WANTED: Final = 3 * _LINE
_WORKER_ASLEEP: Final = 4 * _LINE
_FRAMES_TO_WORKER: Final = 5 * _LINE
_FRAMES_TO_TRAINER: Final = 6 * _LINE
_CURRENT: Final = 7 * _LINE
_CURRENT_SINCE_NS: Final = 7 * _LINE + 1
_WORDS: Final = 8 * _LINE

# _WANTED holds an order number above this many bits, so that an order is obeyed once.
_WANTED_BITS: Final = 24
_WANTED_MASK: Final = (1 << _WANTED_BITS) - 1


# x86 publishes stores in program order; elsewhere the entry could be seen after its count.
_STORES_STAY_IN_ORDER: Final = platform.machine() in ("x86_64", "AMD64")


def _new_fence() -> Callable[[], None]:
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


def entry(number: int, slot: int, op: int) -> int:
    """One ring entry."""
    return (number << NUMBER_SHIFT) | (slot << OP_BITS) | op


def number_of(entry: int) -> int:
    """The number of the request that a ring entry is about."""
    return entry >> NUMBER_SHIFT


def slot_of(entry: int) -> int:
    """The slot of the env that a ring entry is about."""
    return (entry >> OP_BITS) & SLOT_MASK


def op_of(entry: int) -> int:
    """What a ring entry asks for."""
    return entry & OP_MASK


def _capacity(rows: int) -> int:
    # One request of an env may be in flight, so no more than `rows` entries are unread.
    return 1 << rows.bit_length()


def rings_size(rows: int) -> int:
    """Bytes that the words and both rings of a worker with `rows` envs take."""
    return 8 * (_WORDS + 2 * _capacity(rows))


def _split(buffer: memoryview, rows: int) -> tuple[memoryview, memoryview, memoryview]:
    words = buffer.cast("B")[: rings_size(rows)].cast("q")
    capacity = _capacity(rows)
    return words, words[_WORDS : _WORDS + capacity], words[_WORDS + capacity :]


class TrainerRings:
    """The trainer's side: appends requests, reads reports, orders a bell."""

    def __init__(self, buffer: memoryview, rows: int) -> None:
        self._words, requests, reports = _split(buffer, rows)
        self._requests: NDArray[np.int64] = np.frombuffer(requests, np.int64)
        self._reports: NDArray[np.int64] = np.frombuffer(reports, np.int64)
        self._capacity = _capacity(rows)
        self._mask = self._capacity - 1
        self._fence = _new_fence()
        self._sent = 0
        self._read = 0
        self._orders = 0
        self._frames_sent = 0

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

    def unread(self) -> int:
        """Reports that wait to be read."""
        return self._words[_REPORTS_SENT] - self._read

    def reports(self) -> NDArray[np.int64]:
        """Read all reports there are, in order."""
        sent = self._words[_REPORTS_SENT]
        count = sent - self._read
        if not count:
            return self._reports[:0]
        self._fence()
        start = self._read & self._mask
        room = self._capacity - start
        if count <= room:
            found = self._reports[start : start + count].copy()
        else:
            found = np.concatenate((self._reports[start:], self._reports[: count - room]))
        self._fence()
        self._read = sent
        self._words[_REPORTS_READ] = sent
        return found

    def want(self, count: int) -> bool:
        """Order one bell as soon as `count` reports are unread; True if they already are."""
        self._orders += 1
        self._words[_WANTED] = (self._orders << _WANTED_BITS) | count
        self._fence()
        return self.unread() >= count

    def forget_want(self) -> None:
        """Withdraw the order: the trainer is awake."""
        self._words[_WANTED] = 0

    def frames_from_worker(self) -> int:
        """Frames that the worker has sent so far, bells excluded."""
        return self._words[_FRAMES_TO_TRAINER]

    def current(self) -> tuple[int, int]:
        """The entry that the worker is executing (0 if none), and since when.

        The time is in ns of the monotonic clock, which all processes share.
        """
        return self._words[_CURRENT], self._words[_CURRENT_SINCE_NS]


class WorkerRings:
    """The worker's side: reads requests, appends reports, says when it sleeps."""

    def __init__(self, buffer: memoryview, rows: int) -> None:
        self._words, self._requests, self._reports = _split(buffer, rows)
        self._mask = _capacity(rows) - 1
        self._fence = _new_fence()
        self._read = 0
        self._sent = 0
        self._obeyed = 0
        self._frames_sent = 0
        self._frames_seen = 0

    def requests(self) -> list[int]:
        """Read all entries that wait, in order."""
        sent = self._words[_REQUESTS_SENT]
        if sent == self._read:
            return []
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

    def idle(self) -> None:
        """Say that nothing is being executed."""
        self._words[_CURRENT] = 0

    def serve(self, execute: Callable[[int], bool], ring: Callable[[], object]) -> bool:
        """Read the entries that wait and execute them in order; False if there were none.

        Args:
            execute: takes an entry; returns whether it is done and to be reported here.
            ring: wakes the trainer; called when it has ordered that.
        """
        requests = self.requests()
        if not requests:
            return False
        words, reports, mask = self._words, self._reports, self._mask
        for request in requests:
            if not execute(request):
                continue
            reports[self._sent & mask] = request
            self._sent = sent = self._sent + 1
            if not _STORES_STAY_IN_ORDER:
                self._fence()
            words[_REPORTS_SENT] = sent
            # Not fenced: an order that is missed here is seen after the next entry, or below.
            wanted = words[_WANTED]
            if wanted != self._obeyed and sent - words[_REPORTS_READ] >= wanted & _WANTED_MASK:
                self._obey(wanted, ring)
        self._fence()
        wanted = words[_WANTED]
        if wanted != self._obeyed and self._sent - words[_REPORTS_READ] >= wanted & _WANTED_MASK:
            self._obey(wanted, ring)
        return True

    def _obey(self, wanted: int, ring: Callable[[], object]) -> None:
        self._obeyed = wanted
        if wanted:
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
