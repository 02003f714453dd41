"""`Trace`: the timeline of a group, in Chrome's trace event format, which Perfetto opens.

Each result carries the time at which it was ready and the duration in the env, on a clock that all
processes of a machine share. So the trainer records everything when it returns results, and workers
need no code for it. The file has one process for the trainer and one for each host, with a track
for each env.
Rule: a trace is an observer (see `Observed`) and changes nothing; slices of a track nest.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio._core.group.drivers.wait import Scope
from rlightning_aio._core.group.state.request_states import State
from rlightning_aio._core.hosts.base import Executing
from rlightning_aio.files import check_writable, write_file
from rlightning_aio.protocol.entries import NUMBER_SHIFT, Operation, op_of, slot_of

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.core import Core
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio.batch.columns import ResultColumns

KEPT: Final = 1 << 18
"""The number of results that are kept, and of slices of the trainer."""
_TRAINER: Final = 1
"""Number of the trainer among the processes; those of hosts follow."""


class _Slice(NamedTuple):
    """A period of the trainer; all times of this module are ns of the monotonic clock."""

    name: str
    began: int
    ended: int


class _Results:
    """The newest results, in a ring: entry, time of sending, time of the end, time in the env."""

    def __init__(self) -> None:
        self._rows = np.zeros((KEPT, 4), np.int64)
        self._size = self._end = 0

    def add(self, *columns: NDArray[np.int64] | int, size: int) -> None:
        """Add `size` results, the oldest first."""
        places: Any = slice(self._end, self._end + size)
        if self._end + size > KEPT:
            places = np.arange(self._end, self._end + size) % KEPT
        for k, column in enumerate(columns):
            self._rows[places, k] = column
        self._end = (self._end + size) % KEPT
        self._size = min(self._size + size, KEPT)

    def all(self) -> NDArray[np.int64]:
        """Return what is kept, ``[n, 4]``, the oldest first."""
        return np.roll(self._rows, -self._end, axis=0)[KEPT - self._size :]

    @property
    def complete_since(self) -> int:
        """The end of the oldest one that is kept, if any was dropped."""
        return int(self._rows[self._end, 2]) if self._size == KEPT else 0


class Trace(Scope):
    """A timeline recorder: records from `start` to `stop`, or within a ``with``.

    It keeps the newest 262,144 results and as many slices of the trainer, in at most 50 MB of
    memory. `stop` ends the timeline and writes the file completely or not at all (see `files`); a
    full record makes a file of 60 MB and takes a few seconds.
    """

    def __init__(self, core: Core, path: str | Path, running: list[Trace]) -> None:
        self._core = core
        self._path = path
        check_writable(path)
        self._running = running
        self._pid = 0

    def start(self) -> None:
        """Begin to record.

        Raises:
            RuntimeError: a trace of this group is being recorded already.
        """
        if self._running:
            raise RuntimeError("a trace of this group is being recorded already; stop it first")
        self._pid = os.getpid()
        self._results = _Results()
        self._slices: deque[_Slice] = deque(maxlen=KEPT)
        # Requests without a result: entry, beginning in the env, and end.
        self._unfinished: list[tuple[int, int, int]] = []
        self._began = time.monotonic_ns()
        self._running.append(self)
        self._core.observed.attach(self)

    def stop(self) -> None:
        """Stop recording and write the file; do nothing if not recording.

        Raises:
            OSError: the file can't be written.
        """
        if self not in self._running:
            return
        self._running.remove(self)
        self._core.observed.attach(None)
        if self._pid != os.getpid():
            return  # In a forked child; the parent writes the file.
        if self._core.lifetime.open:
            self._note_unreturned()
        write_file(self._path, _document(self._events()))
        del self._results, self._unfinished

    def _enter(self) -> None:
        self.start()

    def _leave(self) -> None:
        self.stop()

    # -- recording --------------------------------------------------------------------

    @contextlib.contextmanager
    def span(self, name: str) -> Generator[None]:
        """A slice of the trainer, recorded when its ``with`` ends."""
        slices, began = self._slices, time.monotonic_ns()
        try:
            yield
        finally:
            slices.append(_Slice(name, began, time.monotonic_ns()))

    def note_call(self, name: str, began: float) -> None:
        if (began_ns := int(began * 1e9)) >= self._began:
            self._slices.append(_Slice(name, began_ns, time.monotonic_ns()))

    def note_results(self, parts: Sequence[ResultColumns]) -> None:
        requests = self._core.requests
        for part in parts:
            slots, times = part.slots, part.times
            columns = requests.numbering.entry[slots], requests.sent_ns[slots]
            self._results.add(*columns, times[:, 0], times[:, 1], size=len(slots))

    def note_hang(self, record: HostRecord) -> None:
        self._note_unfinished(record, time.monotonic_ns())

    def _note_unreturned(self) -> None:
        """Note the results that no call has returned, and the requests that envs execute."""
        requests, now = self._core.requests, time.monotonic_ns()
        for slot in np.flatnonzero(requests.state != int(State.IDLE)).tolist():
            entry, sent = requests.numbering.entry.item(slot), requests.sent_ns.item(slot)
            done, busy = self._last_times(slot)
            if done >= sent:
                self._results.add(entry, sent, done, busy, size=1)
        for record in self._core.supervisor.records:
            self._note_unfinished(record, now)

    def _note_unfinished(self, record: HostRecord, now: int) -> None:
        """Note the requests that a host executes, from their beginning in the env until now."""
        requests = self._core.requests
        slots = self._core.tables.slots_of(record)
        owed: dict[int, int] = {}  # Times of sending by entry, the oldest first.
        for slot in requests.owed(slots).tolist():
            sent = requests.sent_ns.item(slot)
            if self._last_times(slot)[0] < sent:
                owed[requests.numbering.entry.item(slot)] = sent
        for entry, began in _executed(record, owed):
            self._unfinished.append((entry, began, max(now, began)))

    def _last_times(self, slot: int) -> tuple[int, int]:
        """Return when the last result of an env was ready, and how long it took; 0 before."""
        layout = self._core.tables.layout
        if not layout.slabs:
            return 0, 0  # No client has come yet.
        slab, row = layout.of(slot)
        done, busy = slab.times[row].tolist()
        return done, busy

    # -- the file ---------------------------------------------------------------------

    def _events(self) -> Iterator[dict[str, Any]]:
        env_ids, hosts = self._core.envs.env_ids, self._core.requests.hosts.tolist()
        # Track numbers are unique over all processes of the file.
        places = [{"pid": hosts[slot] + 2, "tid": slot + 1} for slot in range(len(env_ids))]
        yield from _named("process", {"pid": _TRAINER}, "trainer", _TRAINER)
        for record in self._core.supervisor.records:
            host = {"pid": record.host.host_id + 2}
            yield from _named("process", host, _title(record), host["pid"])
        for place, env_id in zip(places, env_ids, strict=True):
            yield from _named("thread", place, env_id, place["tid"])
        oldest = self._slices[0].ended if len(self._slices) == KEPT else 0
        since = max(self._began, oldest, self._results.complete_since)
        yield from self._of_trainer(since, len(env_ids) + 1)
        for entry, sent, done, busy in self._results.all().tolist():
            if sent >= since:
                # A client uses another clock, so only the duration of its steps is known.
                began = max(done - busy, sent)
                yield self._request(entry, places, began, max(done, began), "")
        for entry, began, ended in self._unfinished:
            yield self._request(entry, places, max(began, since), ended, ", unfinished")

    def _of_trainer(self, since: int, first_track: int) -> Iterator[dict[str, Any]]:
        rows = 0
        for row, one in _in_rows(one for one in self._slices if one.ended > since):
            place = {"pid": _TRAINER, "tid": first_track + row}
            if row == rows:
                rows += 1
                name = f"trainer {rows}" if row else "trainer"
                yield from _named("thread", place, name, place["tid"])
            yield self._slice(one.name, place, max(one.began, since), one.ended)

    def _slice(self, name: str, place: dict[str, int], began: int, ended: int) -> dict[str, Any]:
        times = {"ts": (began - self._began) / 1e3, "dur": (ended - began) / 1e3}
        return {"name": name, "ph": "X", **place, **times}

    def _request(
        self, entry: int, places: Sequence[dict[str, int]], began: int, ended: int, more: str
    ) -> dict[str, Any]:
        name = Operation(op_of(entry)).name.lower() + more
        found = self._slice(name, places[slot_of(entry)], began, ended)
        return found | {"args": {"request": entry >> NUMBER_SHIFT}}


def _executed(record: HostRecord, owed: dict[int, int]) -> list[tuple[int, int]]:
    """Return those of the requests that a host owes which it executes now, and since when.

    Args:
        record: of the host.
        owed: times of sending by entry, the oldest first.
    """
    if isinstance(record.host, Executing) or record.is_starting or record.is_down:
        return []  # In this process nothing is executed now.
    if record.awaits_several or record.host.needs_loop:
        return list(owed.items())[: record.config.max_concurrency]  # At the same time.
    assert record.killable is not None
    entry, began = record.killable.current_request()
    return [(entry, began)] if entry in owed and began else []


def _title(record: HostRecord) -> str:
    if record.place is not None:
        return f"place {record.place.env_id}"
    where = "inline" if record.killable is None else "worker"
    return f"{where} {record.host.host_id} ({record.config.name})"


def _named(what: str, place: dict[str, int], name: str, position: int) -> Iterator[dict[str, Any]]:
    yield {"name": f"{what}_name", "ph": "M", **place, "args": {"name": name}}
    yield {"name": f"{what}_sort_index", "ph": "M", **place, "args": {"sort_index": position}}


def _in_rows(slices: Iterable[_Slice]) -> Iterator[tuple[int, _Slice]]:
    """Give each slice a row in which it nests: calls of several tasks overlap."""
    rows: list[list[int]] = []  # The ends of the slices that are open.
    for one in sorted(slices, key=lambda each: (each.began, -each.ended)):
        row = next((k for k, around in enumerate(rows) if _nests(one, around)), len(rows))
        if row == len(rows):
            rows.append([])
        rows[row].append(one.ended)
        yield row, one


def _nests(one: _Slice, around: list[int]) -> bool:
    while around and around[-1] <= one.began:
        around.pop()
    return not around or one.ended <= around[-1]


def _document(events: Iterator[dict[str, Any]]) -> Iterator[bytes]:
    separator = '{"traceEvents":[\n'
    for event in events:
        yield f"{separator}{json.dumps(event)}".encode()
        separator = ",\n"
    yield b"\n]}\n"
