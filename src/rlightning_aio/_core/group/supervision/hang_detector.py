"""`HangDetector`: finds workers that exceed a time limit, and ends them by force.

Rule: read pending output before killing a host. The worker measures how long its env takes, and
stops its clock while it waits for the trainer to read. A worker that executes nothing gets its
limit again whenever data passes between the two. Before a kill, the host is asked for completions
that the trainer, late itself, has not read yet. An aborted request has a short limit.

Time limits cost an ordinary step nothing: a few looks within the shortest limit are enough. A
request that is seen in one of them is ended when its time is over, because the next look is then.
The time of a worker that executes nothing begins with the look that finds it so. So its hang is
found too late by the pause between two looks at most, which is a quarter of the shortest limit.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rlightning_aio._core.group.state.host_record import Stage
from rlightning_aio._core.group.supervision.fault_messages import culprit_of
from rlightning_aio._core.hosts import times
from rlightning_aio.protocol.entries import slot_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables


class HangDetector:
    """See the module.

    Attributes:
        due: when to look next for requests that exceed a limit; infinite if none has one.
        any_ending: a killed host has not reported its exit, or requests to a host that can be
            killed were aborted. If neither holds, nothing needs to be checked.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._records = tables.records
        self._requests = tables.requests
        self.any_ending = False
        self.due = math.inf
        self._pause = math.inf

    def add(self, record: HostRecord) -> None:
        """Watch a host whose requests have limits; of another it does nothing."""
        if record.timed:
            pause = times.between_looks(record.limits.values())
            self.due, self._pause = 0.0, min(self._pause, pause)

    def abort(self, slots: NDArray[np.intp], now: float) -> None:
        """Have hosts end the outstanding requests of `slots`, which are aborted.

        A host that can't, and that can be killed, is killed if they don't end soon. Those that are
        held for a replacement end here.
        """
        self._tables.stop_hardware(slots.tolist())
        entries, hosts = self._requests.numbering.entry[slots], self._requests.hosts[slots]
        found: list[int] = sorted({*hosts.tolist()})
        for host_id in found:
            record, own = self._records[host_id], entries[hosts == host_id]
            if record.is_down:
                for entry in record.drop_held(own):
                    self._requests.end(host_id, entry)
                continue
            record.host.abort(own)
            if record.killable is not None:
                record.abort_by |= dict.fromkeys(own.tolist(), now + times.ABORT)
                self.any_ending = True

    def expiries(self) -> list[float | None]:
        """Return the times, besides `due`, when `check` must be called."""
        dying: list[float | None] = [record.die_by for record in self._records if record.dying]
        return dying + [by for r in self._records for by in r.abort_by.values()]

    def check(self, now: float) -> None:
        """Kill workers that have exceeded a limit, and destroy those that survive a kill."""
        if now >= self.due:
            self.due = now + self._pause
            for record in self._records:
                if record.timed and self._in_flight(record):
                    self.due = min(self.due, self._check_hung(record, now))
        if self.any_ending:
            for record in self._records:
                if record.abort_by and not record.dying:
                    self._check_aborted(record, now)
            self._check_dying(now)
            self.any_ending = any(r.dying or r.abort_by for r in self._records)

    def _check_aborted(self, record: HostRecord, now: float) -> None:
        """Kill a worker whose aborted requests go on."""
        goes_on = self._requests.is_current
        record.abort_by = {entry: by for entry, by in record.abort_by.items() if goes_on(entry)}
        entry = min(record.abort_by, key=record.abort_by.__getitem__, default=0)
        if entry and now >= record.abort_by[entry] and not self.read_news(record):
            self._kill_aborted(record, entry)

    def _kill_aborted(self, record: HostRecord, entry: int) -> None:
        record.abort_by, record.aborted_slot = {}, slot_of(entry)
        self.kill(record, dump=False)

    def kill(self, record: HostRecord, *, dump: bool) -> None:
        """Kill a host; with `dump`, its worker writes its stacks first."""
        record.kill(dump=dump)
        if record.killable is not None:
            record.dying = self.any_ending = True
            record.die_by, record.halves_left = 0.0, 2  # Its time begins with the next look.

    def _in_flight(self, record: HostRecord) -> int:
        return self._requests.in_flight[record.host.host_id]

    def _check_hung(self, record: HostRecord, now: float) -> float:
        """Kill a worker that has exceeded a limit, or return the time when it will have."""
        if record.stage is not Stage.UP or record.is_hung or record.aborted_slot is not None:
            return math.inf  # It is starting, or being killed.
        assert record.killable is not None
        entry, _ = current = record.killable.current_request()
        expiry = self._expiry(record, current, now)
        if now < expiry or self.read_news(record):
            return max(expiry, now)
        if entry in record.abort_by:  # It counts as aborted.
            self._kill_aborted(record, entry)
            return math.inf
        record.is_hung = True
        busy = self._requests.owed(self._tables.slots_of(record))
        record.culprit = culprit_of(record, (entry,), self._requests, busy)
        if (observer := self._tables.observed.observer) is not None:
            observer.note_hang(record)
        self.kill(record, dump=True)
        return math.inf

    def _expiry(self, record: HostRecord, current: tuple[int, int], now: float) -> float:
        """Return the time when the worker exceeds its limit, if it continues like this."""
        entry, since_ns = current
        if entry and since_ns:
            limit = record.limits.get(self._requests.numbering.op(slot_of(entry)))
            return math.inf if limit is None else since_ns / 1e9 + limit
        # A stopped process executes none of its requests.
        progress = self._progress(record, current)
        if progress != record.idle:
            record.idle, record.idle_since = progress, now
        return record.idle_since + min(record.limits.values())

    def _progress(self, record: HostRecord, current: tuple[int, int]) -> tuple[int, ...]:
        """Return numbers that change with every request, reply, part of a reply, sign of life."""
        assert record.killable is not None
        slots = self._tables.slots_of(record)
        entries = int(self._requests.numbering.entry[slots].sum())
        # Where all envs wait, the worker says now and then that its event loop runs.
        return self._in_flight(record), entries, record.killable.traffic, *current

    def _check_dying(self, now: float) -> None:
        """Destroy hosts that a kill has not ended, together with their fork server.

        They have twice half the time. If the trainer is stopped in one half, the order to kill, or
        the report of the exit, may have waited for it to make room, and arrives in the other.
        """
        for record in self._records:
            if not record.dying or now < record.die_by or self.read_news(record):
                continue
            if record.halves_left:
                record.die_by = self._tables.clock() + times.OBEY / 2
                record.halves_left -= 1
            else:
                assert record.killable is not None
                record.die_by, record.halves_left = 0.0, 2
                record.killable.destroy()

    def read_news(self, record: HostRecord) -> bool:
        """Read what a host has sent; return True if there was anything, or if anything waits to be
        applied: what it shares with others may have been read for one of them.
        """
        has_news = record.killable is not None and record.killable.catch_up()
        return has_news or bool(self._tables.completions)
