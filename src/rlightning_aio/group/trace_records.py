"""`Records`: what a timeline is made of, in bounded memory.

Numbers only: a result takes 48 bytes, and a span of the trainer some 170. Of a long run the newest
are kept, `KEPT` of each kind.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["KEPT", "Mark", "Records", "Results", "Span"]

KEPT: Final = 1 << 18
"""How many results are kept, and how many spans: the newest."""
_MARKS: Final = 10_000
_BATCHES_APART: Final = 512
_RESULTS_APART: Final = KEPT // 16
"""So many are joined at a time: each batch alone would take more memory for its arrays' headers
than for what is in them."""

_Batch: TypeAlias = "tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int, int]"


class Span(NamedTuple):
    """Something that the trainer did. Times in ns of the monotonic clock, here as everywhere."""

    name: str
    lane: int
    began: int
    ended: int


class Mark(NamedTuple):
    """Something out of the ordinary that has happened.

    Attributes:
        at: when, or until when; began: since when, 0 where it took no time.
        host_id: where; slot: to which env, -1 if to none in particular.
        text: what is to be said of it.
    """

    name: str
    at: int
    host_id: int
    slot: int = -1
    began: int = 0
    text: str = ""


class Results(NamedTuple):
    """Results that were handed out, in that order.

    Attributes:
        entries: of their requests; sent: when these were sent.
        done: when each was ready; busy: the time that the env took.
        taken: when it was handed out; lanes: in which of the trainer's lanes.
    """

    entries: NDArray[np.int64]
    sent: NDArray[np.int64]
    done: NDArray[np.int64]
    busy: NDArray[np.int64]
    taken: NDArray[np.int64]
    lanes: NDArray[np.int64]

    def of(self, which: NDArray[Any]) -> Results:
        """Some of them."""
        return Results(*(column[which] for column in self))


class Records:
    """See the module.

    Attributes:
        add_span: keeps a span as a tuple: the number of its name, its lane, its two times.
        marks: the newest.
    """

    def __init__(self) -> None:
        self._names: dict[str, int] = {}
        self._spans: deque[tuple[int, int, int, int]] = deque(maxlen=KEPT)
        self.add_span = self._spans.append
        self.marks: deque[Mark] = deque(maxlen=_MARKS)
        # Batches as they came, and those before joined to fewer and longer arrays.
        self._batches: list[_Batch] = []
        self._results: deque[Results] = deque()
        self._num_apart = self._num_joined = 0
        # When the last result that was dropped had been handed out.
        self._dropped_until = 0

    def name(self, name: str) -> int:
        """The number that stands for a span's name."""
        return self._names.setdefault(name, len(self._names))

    def add_results(
        self,
        entries: NDArray[np.int64],
        sent: NDArray[np.int64],
        times: NDArray[np.int64],
        taken: int,
        lane: int,
    ) -> None:
        """Keep results that were handed out together; the arrays are nobody else's to change.

        `times` are those of `ResultColumns`.
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
        found = Results(
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
        """All that came after this is kept."""
        full = len(self._spans) == KEPT
        return max(self._dropped_until, self._spans[0][-1] if full else 0)

    def results(self) -> Results:
        """All results that are kept."""
        if self._batches:
            self._join()
        nothing = np.empty(0, np.int64)
        if not self._results:
            return Results(*[nothing] * len(Results._fields))
        return Results(*(np.concatenate(parts) for parts in zip(*self._results, strict=True)))

    def spans(self) -> list[Span]:
        """All spans that are kept, in the order in which they ended."""
        names = list(self._names)
        return [Span(names[name], *rest) for name, *rest in self._spans]
