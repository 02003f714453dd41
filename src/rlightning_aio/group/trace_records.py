"""`Records`: what a timeline is made of, in bounded memory.

Numbers only, written into arrays that are there already: a result costs 32 bytes and so does a
span. Of a long run the newest are kept, `KEPT` of each kind.
"""

from __future__ import annotations

from array import array
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["KEPT", "Mark", "Records", "Results", "Span"]

_CHUNK: Final = 1 << 14
_NUM_CHUNKS: Final = 16
KEPT: Final = _CHUNK * _NUM_CHUNKS
"""How many results are kept, and how many spans: the newest."""
_MARKS: Final = 10_000
_SPAN_FIELDS: Final = 4


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


class _Chunk:
    """Room for some results, and for each batch of them what all have in common."""

    def __init__(self, size: int) -> None:
        self.entries = np.empty(size, np.int64)
        self.sent = np.empty(size, np.int64)
        self.times = np.empty((size, 2), np.int64)
        self.size = size
        self.used = 0
        # Of each batch: where it ends, when it was handed out, and in which lane.
        self.batches = array("q")

    def results(self) -> Results:
        ends, taken, lanes = np.array(self.batches, np.int64).reshape(-1, 3).T
        counts = np.diff(ends, prepend=0)
        n = self.used
        times = self.times[:n].T
        each = (np.repeat(taken, counts), np.repeat(lanes, counts))
        return Results(self.entries[:n], self.sent[:n], times[0], times[1], *each)


class Records:
    """See the module.

    Attributes:
        marks: the newest.
    """

    def __init__(self) -> None:
        self._chunks: deque[_Chunk] = deque(maxlen=_NUM_CHUNKS)
        self._chunk = self._next_chunk(_CHUNK)
        self._spans: deque[array[int]] = deque([array("q")], maxlen=_NUM_CHUNKS)
        self._names: dict[str, int] = {}
        self.marks: deque[Mark] = deque(maxlen=_MARKS)
        # Until then something may be missing.
        self._complete_since = 0

    def _next_chunk(self, size: int) -> _Chunk:
        if len(self._chunks) == _NUM_CHUNKS:
            self._complete_since = max(self._complete_since, self._chunks[0].batches[-2])
        chunk = _Chunk(size)
        self._chunks.append(chunk)
        return chunk

    def name(self, name: str) -> int:
        """The number that stands for a span's name."""
        return self._names.setdefault(name, len(self._names))

    def add_span(self, name: int, lane: int, began: int, ended: int) -> None:
        """Keep what was done from `began` until `ended`."""
        spans = self._spans[-1]
        spans.extend((name, lane, began, ended))
        if len(spans) >= _CHUNK * _SPAN_FIELDS:
            if len(self._spans) == _NUM_CHUNKS:
                self._complete_since = max(self._complete_since, self._spans[0][-1])
            self._spans.append(array("q"))

    def add_results(
        self,
        entries: NDArray[np.int64],
        sent: NDArray[np.int64],
        times: NDArray[np.int64],
        taken: int,
        lane: int,
    ) -> None:
        """Keep results that were handed out together; `times` are those of `ResultColumns`."""
        chunk = self._chunk
        begin, count = chunk.used, len(entries)
        end = begin + count
        if end > chunk.size:
            chunk = self._chunk = self._next_chunk(max(count, _CHUNK))
            begin, end = 0, count
        chunk.entries[begin:end] = entries
        chunk.sent[begin:end] = sent
        chunk.times[begin:end] = times
        chunk.used = end
        chunk.batches.extend((end, taken, lane))

    @property
    def complete_since(self) -> int:
        """All that began after this is kept."""
        return self._complete_since

    def results(self) -> Results:
        """All results that are kept."""
        parts = [chunk.results() for chunk in self._chunks]
        return Results(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def spans(self) -> list[Span]:
        """All spans that are kept, in the order in which they ended."""
        names = list(self._names)
        found: list[Span] = []
        for chunk in self._spans:
            rows: Sequence[Sequence[int]] = (
                np.array(chunk, np.int64).reshape(-1, _SPAN_FIELDS).tolist()
            )
            found += [Span(names[name], *rest) for name, *rest in rows]
        return found
