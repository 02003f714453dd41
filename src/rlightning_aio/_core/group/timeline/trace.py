"""`Trace`: records a timeline of a group, and writes it to a file.

Each result carries the time at which it was ready and the duration in the env, on a clock that all
processes of a machine share. So the trainer records everything when it returns results, and workers
need no code for it.
Rule: a trace is an observer (see `observed`) and changes nothing.
"""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import numpy as np

from rlightning_aio._core.group.drivers.scope import Scope
from rlightning_aio._core.group.state.request_states import State
from rlightning_aio._core.group.timeline.file import HostTrack, Timeline, events
from rlightning_aio._core.group.timeline.records import Mark, Records
from rlightning_aio.files import check_writable, write_file
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.core import Core
    from rlightning_aio._core.group.state.conditions import Fate
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.outcomes import Outcome

__all__ = ["Trace"]

_Owner: TypeAlias = "asyncio.Task[Any] | int"
_Noted: TypeAlias = "tuple[int, int, NDArray[np.int64], NDArray[np.int64]]"
"""Lane, time, and the entries and send times of the requests of results."""

_current_task: Final = asyncio.current_task


class Trace(Scope):
    """A timeline recorder: records from `start` to `stop`, or within a ``with``.

    It keeps the newest 262,144 results and as many spans of the trainer, in at most 60 MB of
    memory. `stop` writes the file completely or not at all (see `files`); a full record makes a
    file of 100 MB and takes a few seconds.
    """

    def __init__(self, core: Core, path: str | Path, running: list[Trace], *, by_task: bool):
        self._core = core
        self._path = path
        check_writable(path)
        self._running = running
        self._owner = _task_or_thread if by_task else threading.get_ident
        self._pid = 0

    # -- life -------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to record.

        Raises:
            RuntimeError: a trace of this group is being recorded already.
        """
        if self._running:
            raise RuntimeError("a trace of this group is being recorded already; stop it first")
        self._pid = os.getpid()
        self._records = Records()
        self._lanes = _Lanes(self._owner)
        self._lanes.current()
        self._down_since: dict[int, int] = {}
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
        self._note_unfinished()
        timeline = self._timeline()
        del self._records
        write_file(self._path, _document(timeline))

    def _enter(self) -> None:
        self.start()

    def _leave(self) -> None:
        self.stop()

    # -- recording --------------------------------------------------------------------

    def span(self, name: str) -> AbstractContextManager[Any]:
        """A span of the trainer, recorded when its ``with`` ends."""
        return _Span(self._records, self._lanes, self._records.name(name))

    def note_call(self, name: str, began: float) -> None:
        # From its very beginning, so that its requests are within its span.
        if (began_ns := int(began * 1e9)) >= self._began:
            number, lane = self._records.name(name), self._lanes.current()
            self._records.add_span((number, lane, began_ns, time.monotonic_ns()))

    def before_results(self, slots: NDArray[np.intp]) -> _Noted:
        requests = self._core.requests
        return (
            self._lanes.current(),
            time.monotonic_ns(),
            requests.numbering.entry[slots],
            requests.sent_ns[slots],
        )

    def after_results(self, noted: _Noted, parts: Sequence[ResultColumns]) -> None:
        lane, began, entries, sent = noted
        for part in parts:
            own = ... if part.positions is None else part.positions
            self._records.add_results(entries[own], sent[own], part.times, began, lane)
            if part.limit_reached is not None or part.restarted is not None:
                self._note_flags(part)
        self._records.add_span((self._records.name("hand out"), lane, began, time.monotonic_ns()))

    def _note_flags(self, part: ResultColumns) -> None:
        flags = {"step limit": part.limit_reached, "episode lost": part.restarted}
        for name, flag in flags.items():
            for row in np.flatnonzero(flag if flag is not None else ()).tolist():
                slot, done = part.slots.item(row), part.times.item(row, 0)
                host_id, lost = self._core.requests.hosts.item(slot), part.out_of_band.get(row)
                outcome: Outcome | None = None
                if isinstance(lost, dict):
                    outcome = cast("dict[str, Any]", lost).get("info", {}).get("outcome")
                self._mark(name, done, host_id, slot, outcome=outcome)

    def _mark(self, name: str, at: int, host_id: int, slot: int = -1, **more: Any) -> None:
        self._records.marks.append(Mark(name, at, host_id, slot, **more))

    def note_fate(self, fate: Fate, host_id: int, slot: int, cause: str) -> None:
        now = time.monotonic_ns()
        if fate == "up":
            if host_id in self._down_since:
                began = self._down_since.pop(host_id)
                self._mark("being replaced", now, host_id, began=began)
            return
        if fate == "hung":
            self._note_unanswered(slot, "hung", now)
        elif fate == "died":
            self._down_since.setdefault(host_id, now)
        self._mark(fate, now, host_id, text=cause)

    def _note_unanswered(self, slot: int, state: str, now: int) -> None:
        """Mark a request without a result, from its start in the env, or else from its sending."""
        requests = self._core.requests
        host_id = requests.hosts.item(slot)
        killable = self._core.supervisor.records[host_id].killable
        # Only workers with time limits report the request that they execute. An actor's time may
        # be in the future, as it includes an allowance for the transfer.
        entry, since = (0, 0) if killable is None else killable.current_request()
        if entry != requests.numbering.entry.item(slot) or not 0 < since <= now:
            since = requests.sent_ns.item(slot)
        name = f"{Operation(requests.numbering.op(slot)).name.lower()}, {state}"
        self._mark(name, now, host_id, slot, began=since)

    def _note_unfinished(self) -> None:
        if self._core.lifetime.open:
            now, busy = time.monotonic_ns(), self._core.requests.state == int(State.BUSY)
            for slot in np.flatnonzero(busy).tolist():
                self._note_unanswered(slot, "not done", now)

    # -- the timeline -----------------------------------------------------------------

    def _timeline(self) -> Timeline:
        records = self._records
        return Timeline(
            began=self._began,
            since=max(self._began, records.complete_since),
            lanes=self._lanes.names,
            hosts=[self._track(record) for record in self._core.supervisor.records],
            spans=records.spans(),
            results=records.results(),
            marks=list(records.marks),
        )

    def _track(self, record: HostRecord) -> HostTrack:
        first = record.slots.start
        names = self._core.envs.env_ids[first : record.slots.stop]
        if record.membership is not None:
            server_id = record.membership.server_id
            return HostTrack(f"env_server {server_id}", "all clients", first, names)
        where = "inline" if record.killable is None else "worker"
        name = f"{where} {record.host.host_id} ({record.config.name})"
        return HostTrack(name, "worker", first, names)


class _Span:
    """Records a span for each ``with``."""

    __slots__ = ("_began", "_lane", "_lanes", "_number", "_records")

    def __init__(self, records: Records, lanes: _Lanes, number: int) -> None:
        self._records = records
        self._lanes = lanes
        self._number = number

    def __enter__(self) -> None:
        self._lane = self._lanes.current()
        self._began = time.monotonic_ns()

    def __exit__(self, *error: object) -> None:
        self._records.add_span((self._number, self._lane, self._began, time.monotonic_ns()))


class _Lanes:
    """The tracks of the trainer: one for each live task or thread, as spans of one track nest.

    A new task or thread takes over the lane of one that has ended.

    Attributes:
        names: of the lanes; lane 0 belongs to the task or thread that started recording.
    """

    def __init__(self, owner: Callable[[], _Owner]) -> None:
        self._owner = owner
        self._lane_of: dict[_Owner, int] = {}
        # Threads are keyed by their identifier, and this maps it to the thread object.
        self._live: dict[_Owner, asyncio.Task[Any] | threading.Thread] = {}
        self.names: list[str] = []

    def current(self) -> int:
        """The lane of the current task or thread."""
        owner = self._owner()
        lane = self._lane_of.get(owner)
        return self._take(owner) if lane is None else lane

    def _take(self, owner: _Owner) -> int:
        live = threading.current_thread() if isinstance(owner, int) else owner
        ended = next((one for one, live in self._live.items() if _has_ended(live)), None)
        if ended is not None:
            del self._live[ended]
            lane = self._lane_of.pop(ended)
        else:
            lane = len(self.names)
            name = live.get_name() if isinstance(live, asyncio.Task) else live.name
            self.names.append(name if lane else "trainer")
        self._lane_of[owner], self._live[owner] = lane, live
        return lane


def _task_or_thread() -> _Owner:
    try:
        return _current_task() or threading.get_ident()
    except RuntimeError:  # No loop runs in this thread.
        return threading.get_ident()


def _has_ended(owner: asyncio.Task[Any] | threading.Thread) -> bool:
    return owner.done() if isinstance(owner, asyncio.Task) else not owner.is_alive()


def _document(timeline: Timeline) -> Iterator[bytes]:
    cut = (timeline.since - timeline.began) / 1e9
    yield f'{{"otherData":{{"seconds_not_kept":{json.dumps(cut)}}},"traceEvents":[\n'.encode()
    separator = ""
    for event in events(timeline):
        yield f"{separator}{event}".encode()
        separator = ",\n"
    yield b"\n]}\n"
