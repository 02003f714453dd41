"""`Records`: the records of a timeline, in bounded memory.

A result takes 48 bytes, and a span of the trainer about 170. The newest `KEPT` results and as many
spans are kept.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.outcomes import Outcome

__all__ = ["KEPT", "Mark", "Records", "Span", "TracedResults"]

KEPT: Final = 1 << 18
"""The number of results that are kept, and of spans."""
_MARKS: Final = 10_000
_BATCHES_APART: Final = 512
_RESULTS_APART: Final = KEPT // 16
"""Batches are joined when they hold this many results, as array headers would take more memory than
the content of small batches."""

_Batch: TypeAlias = "tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int, int]"


class Span(NamedTuple):
    """A period of work in the trainer. All times in this module are ns of the monotonic clock."""

    name: str
    lane: int
    began: int
    ended: int


class Mark(NamedTuple):
    """An unusual event.

    Attributes:
        at: its time or end; began: its start, 0 for an event without a duration.
        host_id: of its host; slot: of its env, or -1.
        text: its cause.
        outcome: of an episode that was lost.
    """

    name: str
    at: int
    host_id: int
    slot: int = -1
    began: int = 0
    text: str = ""
    outcome: Outcome | None = None


class TracedResults(NamedTuple):
    """Columns over results, in the order of their return.

    Attributes:
        entries: of their requests; sent: the times of sending.
        done: the times at which they were ready; busy: the durations in the env.
        taken: the times of their return; lanes: the lanes of the trainer that got them.
    """

    entries: NDArray[np.int64]
    sent: NDArray[np.int64]
    done: NDArray[np.int64]
    busy: NDArray[np.int64]
    taken: NDArray[np.int64]
    lanes: NDArray[np.int64]

    def where(self, mask: NDArray[np.bool_]) -> TracedResults:
        """The results that `mask` selects."""
        return TracedResults(*(column[mask] for column in self))


class Records:
    """The newest spans, results and marks of a recording.

    Attributes:
        add_span: adds a span, a tuple of the number of its name, its lane, its start and its end.
        marks: the newest 10,000.
    """

    def __init__(self) -> None:
        self._names: dict[str, int] = {}
        self._spans: deque[tuple[int, int, int, int]] = deque(maxlen=KEPT)
        self.add_span = self._spans.append
        self.marks: deque[Mark] = deque(maxlen=_MARKS)
        # The latest batches, and earlier ones joined into longer arrays.
        self._batches: list[_Batch] = []
        self._results: deque[TracedResults] = deque()
        self._num_apart = self._num_joined = 0
        # The time at which the last dropped result was returned.
        self._dropped_until = 0

    def name(self, name: str) -> int:
        """The number of a span's name."""
        return self._names.setdefault(name, len(self._names))

    def add_results(
        self,
        entries: NDArray[np.int64],
        sent: NDArray[np.int64],
        times: NDArray[np.int64],
        taken: int,
        lane: int,
    ) -> None:
        """Add results that were returned together; the caller must not change the arrays later.

        Args:
            entries: of the requests.
            sent: the times of sending.
            times: of `ResultColumns`.
            taken: the time of the return.
            lane: of the trainer.
        """
        self._batches.append((entries, sent, times, taken, lane))
        self._num_apart += len(entries)
        if len(self._batches) == _BATCHES_APART or self._num_apart >= _RESULTS_APART:
            self._join()

    def _join(self) -> None:
        entries, sent, times, taken, lanes = zip(*self._batches, strict=True)
        self._batches.clear()
        self._num_apart = 0
        counts = [len(part) for part in entries]
        done, busy = np.concatenate(times).T
        found = TracedResults(
            np.concatenate(entries),
            np.concatenate(sent),
            done,
            busy,
            np.repeat(taken, counts),
            np.repeat(lanes, counts),
        )
        self._results.append(found)
        self._num_joined += len(found.entries)
        while self._num_joined > KEPT and len(self._results) > 1:
            dropped = self._results.popleft()
            self._num_joined -= len(dropped.entries)
            self._dropped_until = int(dropped.taken.max(initial=self._dropped_until))

    @property
    def complete_since(self) -> int:
        """The time since which no record was dropped."""
        full = len(self._spans) == KEPT
        return max(self._dropped_until, self._spans[0][-1] if full else 0)

    def results(self) -> TracedResults:
        """The kept results."""
        if self._batches:
            self._join()
        nothing = np.empty(0, np.int64)
        if not self._results:
            return TracedResults(*[nothing] * len(TracedResults._fields))
        return TracedResults(*(np.concatenate(parts) for parts in zip(*self._results, strict=True)))

    def spans(self) -> list[Span]:
        """The kept spans, in the order of their ends."""
        names = list(self._names)
        return [Span(names[name], *rest) for name, *rest in self._spans]
