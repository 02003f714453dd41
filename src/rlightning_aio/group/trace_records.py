"""`Records`: what a timeline is made of, in bounded memory.

Numbers only: a result takes 32 bytes, its batch 24, and a span of the trainer some 170. Of a long
run the newest are kept, `KEPT` of each kind.
"""

from __future__ import annotations

from array import array
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["KEPT", "Mark", "Records", "Results", "Span"]

KEPT: Final = 1 << 18
"""How many results are kept, and how many spans: the newest."""
_MARKS: Final = 10_000
_PAGES: Final = 16
_PAGE: Final = KEPT // _PAGES
"""Results of a page: the oldest are dropped by the page."""


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


class _Page:
    """Results one after the other, as bytes: nothing costs less to add to, or to keep.

    Attributes:
        entries, sent, times: columns of int64, the last one of pairs.
        batches: of each batch the number of its results, when they were taken, and the lane.
    """

    __slots__ = ("batches", "entries", "sent", "times")

    def __init__(self) -> None:
        self.entries, self.sent, self.times = bytearray(), bytearray(), bytearray()
        self.batches = array("q")

    def results(self) -> Results:
        """What is on it."""
        entries, sent, times, batches = (
            np.frombuffer(column, np.int64)
            for column in (self.entries, self.sent, self.times, self.batches)
        )
        (done, busy), (counts, taken, lanes) = times.reshape(-1, 2).T, batches.reshape(-1, 3).T
        return Results(entries, sent, done, busy, taken.repeat(counts), lanes.repeat(counts))


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
        self._pages: deque[_Page] = deque([_Page()])
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
        """Keep results that were handed out together; `times` are those of `ResultColumns`."""
        page = self._pages[-1]
        if len(page.entries) // 8 + len(entries) > _PAGE and page.batches:
            page = self._turn()
        page.entries.extend(entries.tobytes())
        page.sent.extend(sent.tobytes())
        page.times.extend(times.tobytes())
        page.batches.extend((len(entries), taken, lane))

    def _turn(self) -> _Page:
        """Begin a page."""
        if len(self._pages) == _PAGES:
            _, self._dropped_until, _ = self._pages.popleft().batches[-3:]
        self._pages.append(_Page())
        return self._pages[-1]

    @property
    def complete_since(self) -> int:
        """All that came after this is kept."""
        full = len(self._spans) == KEPT
        return max(self._dropped_until, self._spans[0][-1] if full else 0)

    def results(self) -> Results:
        """All results that are kept."""
        parts = [page.results() for page in self._pages]
        return Results(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def spans(self) -> list[Span]:
        """All spans that are kept, in the order in which they ended."""
        names = list(self._names)
        return [Span(names[name], *rest) for name, *rest in self._spans]
