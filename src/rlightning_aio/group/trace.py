"""`Trace`: records a timeline of a group, and writes it to a file.

Workers tell with each result when it was ready and how long the env took, on a clock that all
processes of a machine share. So everything is noted in the trainer, where results are handed out,
and workers know nothing of it.
Rule: who records nothing pays nothing. The core has no branch for this: while a trace runs, its
procedures are covered by ones that look at the clock before and after.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from rlightning_aio.batch.data import parts_of
from rlightning_aio.group.requests import State
from rlightning_aio.group.scope import Scope
from rlightning_aio.group.trace_file import HostTrack, Timeline, events
from rlightning_aio.group.trace_records import Mark, Records
from rlightning_aio.hosts.base import Killable, Membership
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.group.core import Core, Flags
    from rlightning_aio.group.supervisor import Fate
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.hosts.base import Host

__all__ = ["NO_SPAN", "Trace", "check_writable"]

_Owner: TypeAlias = "asyncio.Task[Any] | int"

NO_SPAN: Final = contextlib.nullcontext()
"""What `EnvGroup.span` returns while nothing is recorded."""

# Methods of the core, what their spans are called, and which argument is the time.
_CALLS: Final = {
    "step_async": ("step_async", 1),
    "reset_async": ("reset_async", 0),
    "calls.call_async": ("call_async", 0),
}
_PROCEDURES: Final = {
    "start": ("init", 0),
    "collect": ("collect_async", 0),
    "step": ("step", 1),
    "reset": ("reset", 0),
    "reset_members": ("reset", 0),
    "calls.call": ("call", 0),
    "calls.call_all": ("call", 0),
    "calls.collect_calls": ("collect_calls", 0),
    "snapshot": ("snapshot", 0),
    "restore": ("restore", 0),
}
_clock: Final = time.monotonic_ns
_current_task: Final = asyncio.current_task


class Trace(Scope):
    """What `EnvGroup.trace` returns: it records from `start` to `stop`, or within a ``with``.

    The newest 262,144 results are kept, and as many spans of the trainer, which takes some 60 MB of
    memory at most, however long it runs. The file is written by `stop`, under another name until it
    is whole, so there is never half of one; some 100 MB in some seconds, if the record is full.
    """

    def __init__(self, core: Core, path: str | Path, running: list[Trace], *, by_task: bool):
        self._core = core
        self._path = Path(path)
        check_writable(self._path)
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
        self._began = _clock()
        self._running.append(self)
        self._cover()

    def stop(self) -> None:
        """Write the file. Nothing happens where nothing is being recorded.

        Raises:
            OSError: the file can't be written.
        """
        if self not in self._running:
            return
        self._running.remove(self)
        self._uncover()
        if self._pid != os.getpid():
            return  # Forked meanwhile: it is the other process's.
        self._note_unfinished()
        timeline = self._timeline()
        del self._records
        _write(self._path, timeline)

    def _enter(self) -> None:
        self.start()

    def _leave(self) -> None:
        self.stop()

    # -- recording --------------------------------------------------------------------

    def span(self, name: str) -> contextlib.AbstractContextManager[Any]:
        """See `EnvGroup.span`."""
        return _Span(self._records, self._lanes, self._records.name(name))

    def _cover(self) -> None:
        core = self._core
        for path, (name, place) in _CALLS.items():
            part, method = self._part(path)
            vars(part)[method] = self._covered_call(getattr(part, method), name, place)
        for path, (name, place) in _PROCEDURES.items():
            part, method = self._part(path)
            vars(part)[method] = self._covered_procedure(getattr(part, method), name, place)
        vars(core)["hand_out"] = self._covered_hand_out(core.hand_out)
        self._told_before = core.supervisor.tell_of
        core.supervisor.tell_of = self._note_fate

    def _uncover(self) -> None:
        for path in (*_CALLS, *_PROCEDURES, "hand_out"):
            part, method = self._part(path)
            del vars(part)[method]
        self._core.supervisor.tell_of = self._told_before

    def _part(self, path: str) -> tuple[object, str]:
        """The part of the core that has what `path` names, and its name there."""
        part, _, method = path.rpartition(".")
        return (getattr(self._core, part) if part else self._core), method

    def _covered_call(
        self, call: Callable[..., None], name: str, place: int
    ) -> Callable[..., None]:
        add, lane_of, number = self._records.add_span, self._lanes.current, self._records.name(name)

        def covered(*args: Any) -> None:
            lane = lane_of()
            try:
                call(*args)
            finally:
                # As requests have it: what is sent is sent within this.
                add((number, lane, int(args[place] * 1e9), _clock()))

        return covered

    def _covered_procedure(
        self, procedure: Callable[..., Procedure[Any]], name: str, place: int
    ) -> Callable[..., Procedure[Any]]:
        add, lane_of, number = self._records.add_span, self._lanes.current, self._records.name(name)

        def covered(*args: Any, **options: Any) -> Procedure[Any]:
            lane = lane_of()
            try:
                return (yield from procedure(*args, **options))
            finally:
                add((number, lane, int(args[place] * 1e9), _clock()))

        return covered

    def _covered_hand_out(
        self, hand_out: Callable[..., tuple[BatchedData, Flags]]
    ) -> Callable[..., tuple[BatchedData, Flags]]:
        records, lane_of, requests = self._records, self._lanes.current, self._core.requests
        entry_of, sent_of, number = requests.entry, requests.sent_ns, records.name("hand out")
        add = records.add_results

        def covered(slots: NDArray[np.intp], *, synchronous: bool) -> tuple[BatchedData, Flags]:
            lane, began = lane_of(), _clock()
            # Before it, since the next request may follow within.
            entries, sent = entry_of[slots], sent_of[slots]
            batch, flags = hand_out(slots, synchronous=synchronous)
            for part in parts_of(batch):
                own = part.positions
                if own is None:
                    add(entries, sent, part.times, began, lane)
                else:
                    add(entries[own], sent[own], part.times, began, lane)
                if part.limit_reached is not None or part.restarted is not None:
                    self._note_flags(part)
            records.add_span((number, lane, began, _clock()))
            return batch, flags

        return covered

    def _note_flags(self, part: ResultColumns) -> None:
        flags = {"step limit": part.limit_reached, "episode lost": part.restarted}
        for name, flag in flags.items():
            for row in np.flatnonzero(flag if flag is not None else ()).tolist():
                slot, done = part.slots.item(row), part.times.item(row, 0)
                self._mark(name, done, self._core.requests.host_of(slot), slot)

    def _mark(self, name: str, at: int, host_id: int, slot: int = -1, **more: Any) -> None:
        self._records.marks.append(Mark(name, at, host_id, slot, **more))

    def _note_fate(self, what: Fate, host_id: int, slot: int, text: str) -> None:
        """Take note of what has befallen a host; see `Supervisor.tell_of`."""
        now = _clock()
        if what == "up":
            if host_id in self._down_since:
                began = self._down_since.pop(host_id)
                self._mark("being replaced", now, host_id, began=began)
            return
        if what == "hung":
            self._note_unanswered(slot, "hung", now)
        elif what == "died":
            self._down_since.setdefault(host_id, now)
        self._mark(what, now, host_id, text=text)

    def _note_unanswered(self, slot: int, state: str, now: int) -> None:
        """Take note of a request without a result, since it was begun, or else was sent."""
        requests = self._core.requests
        host = self._core.supervisor.hosts[requests.host_of(slot)]
        # Only a worker with time limits tells what it executes.
        entry, since = host.executing() if isinstance(host, Killable) else (0, 0)
        if entry != requests.entry.item(slot) or not since:
            since = requests.sent_ns.item(slot)
        name = f"{Operation(requests.op(slot)).name.lower()}, {state}"
        self._mark(name, now, host.host_id, slot, began=since)

    def _note_unfinished(self) -> None:
        if self._core.supervisor.open:
            now, busy = _clock(), self._core.requests.state == int(State.BUSY)
            for slot in np.flatnonzero(busy).tolist():
                self._note_unanswered(slot, "not done", now)

    # -- what comes of it -------------------------------------------------------------

    def _timeline(self) -> Timeline:
        records = self._records
        return Timeline(
            began=self._began,
            since=max(self._began, records.complete_since),
            lanes=self._lanes.names,
            hosts=[self._track(host) for host in self._core.supervisor.hosts],
            spans=records.spans(),
            results=records.results(),
            marks=list(records.marks),
        )

    def _track(self, host: Host) -> HostTrack:
        envs, first = self._core.envs, host.first_slot
        names = envs.env_ids[first : first + host.num_envs]
        if isinstance(host, Membership):
            return HostTrack(f"env_server {host.server_id}", "all clients", first, names)
        where = "worker" if isinstance(host, Killable) else "inline"
        name = f"{where} {host.host_id} ({envs.configs[first].name})"
        return HostTrack(name, "worker", first, names)


class _Span:
    """One span at a time: a new one for each ``with``."""

    __slots__ = ("_began", "_lane", "_lanes", "_number", "_records")

    def __init__(self, records: Records, lanes: _Lanes, number: int) -> None:
        self._records = records
        self._lanes = lanes
        self._number = number

    def __enter__(self) -> None:
        self._lane = self._lanes.current()
        self._began = _clock()

    def __exit__(self, *error: object) -> None:
        self._records.add_span((self._number, self._lane, self._began, _clock()))


class _Lanes:
    """The trainer's tracks: one for each task, or thread, that is at work; spans of one nest.

    Those of tasks and threads that are over go to others.

    Attributes:
        names: the first is that of whoever began to record.
    """

    def __init__(self, owner: Callable[[], _Owner]) -> None:
        self._owner = owner
        self._lane_of: dict[_Owner, int] = {}
        # As an owner of a lane, a thread is its number; here it is itself.
        self._at_work: dict[_Owner, asyncio.Task[Any] | threading.Thread] = {}
        self.names: list[str] = []

    def current(self) -> int:
        """The lane of the task or thread that asks."""
        owner = self._owner()
        lane = self._lane_of.get(owner)
        return self._take(owner) if lane is None else lane

    def _take(self, owner: _Owner) -> int:
        at_work = threading.current_thread() if isinstance(owner, int) else owner
        over = next((one for one, who in self._at_work.items() if _is_over(who)), None)
        if over is not None:
            del self._at_work[over]
            lane = self._lane_of.pop(over)
        else:
            lane = len(self.names)
            name = at_work.get_name() if isinstance(at_work, asyncio.Task) else at_work.name
            self.names.append(name if lane else "trainer")
        self._lane_of[owner], self._at_work[owner] = lane, at_work
        return lane


def _task_or_thread() -> _Owner:
    try:
        return _current_task() or threading.get_ident()
    except RuntimeError:  # No loop runs in this thread.
        return threading.get_ident()


def _is_over(who: asyncio.Task[Any] | threading.Thread) -> bool:
    return who.done() if isinstance(who, asyncio.Task) else not who.is_alive()


def check_writable(path: Path) -> None:
    """Raises OSError, saying why `path` can't be written, if that can be known."""
    folder = path.parent
    if not folder.is_dir():
        raise FileNotFoundError(f"can't write the timeline {path}: there is no folder {folder}")
    if path.is_dir():
        raise IsADirectoryError(f"can't write the timeline {path}: it is a folder")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"can't write the timeline {path}: folder {folder} is not writable")


def _write(path: Path, timeline: Timeline) -> None:
    unfinished = path.with_name(f"{path.name}.part")
    try:
        with unfinished.open("w", encoding="utf-8") as file:
            file.writelines(_document(timeline))
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def _document(timeline: Timeline) -> Iterator[str]:
    cut = (timeline.since - timeline.began) / 1e9
    yield f'{{"otherData":{{"seconds_not_kept":{json.dumps(cut)}}},"traceEvents":[\n'
    separator = ""
    for event in events(timeline):
        yield f"{separator}{event}"
        separator = ",\n"
    yield "\n]}\n"
