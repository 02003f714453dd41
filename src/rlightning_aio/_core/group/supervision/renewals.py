"""`Renewals`: replaces workers before they fail (`EnvConfig.recycle`), one env after the other.

Each host of such an entry has a peer with the same slots. Some time before its worker is due, the
peer starts the next. Each env goes over when its own episode has ended, so that none waits for the
others, and the worker that has no env left is closed. If the next one can't be started, the worker
goes on, and it is tried again.
Left out: when a worker is due (see `hosts.running.renewal`), and what a death means: the deaths
that are set to ``{None: 0}`` here count none (see `HostRecord`).
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rlightning_aio._core.group.state.host_record import Stage

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.messages import Moved

_log = logging.getLogger("rlightning_aio")


class Renewals:
    """See the module.

    Args:
        tables: of the group.
        start: starts the worker of a host that is down, at once.
        note_change: called when a worker starts or closes, as `Supervisor.check` must now look at
            the time that it takes.

    Attributes:
        on_move: gets a host, and the slots that it has from now on.
    """

    def __init__(
        self,
        tables: Tables,
        start: Callable[[int], object],
        note_change: Callable[[], None],
    ) -> None:
        self._tables = tables
        self._start = start
        self._note_change = note_change
        self.on_move: Callable[[int, Sequence[int]], None]

    def take_over(self, moved: Moved, slot: int) -> int:
        """Return the host that executes a reset, the next one or the same; start it if need be."""
        record = self._tables.records[moved.host_id]
        record.resident_mb = max(record.resident_mb, moved.resident_mb)
        peer = record.peer
        assert peer is not None
        # Ahead of time, one new worker of an entry is enough: others come as they are due.
        if peer.stage is Stage.CLOSED and (moved.is_due or not self._has_spare(record)):
            peer.started, peer.order = record.started, record.order
            peer.stage, peer.is_next, peer.restart_at = Stage.DOWN, True, self._tables.clock()
            peer.restarts -= 1  # This is none.
            peer.deaths, peer.culprit, peer.last_loss = {None: 0}, None, None
            self._note_change()
            self._start(peer.host.host_id)
        is_coming = peer.is_down and not any(peer.deaths.values())  # No start of it has failed.
        if not (moved.is_due and peer.is_next and (is_coming or peer.stage is Stage.UP)):
            return moved.host_id
        record.waits += is_coming
        self._move(peer, [slot])
        return peer.host.host_id

    def _has_spare(self, record: HostRecord) -> bool:
        """Return True if the entry has a worker that waits for its first env."""
        name = record.config.name
        own = (r for r in self._tables.records if r.is_next and r.config.name == name)
        return any(not len(self._tables.slots_of(other)) for other in own)

    def _move(self, record: HostRecord, slots: Sequence[int]) -> None:
        """Give envs to a host, with what they are blamed for."""
        for slot in slots:
            if count := self._tables.record_of(slot).deaths.pop(slot, 0):
                record.deaths[slot] = count
        self._tables.requests.hosts[slots] = record.host.host_id
        self.on_move(record.host.host_id, slots)

    def close_if_left(self, host_id: int) -> None:
        """Close the worker of a host if all its envs have gone over to one that is up."""
        record = self._tables.records[host_id]
        peer = record.peer
        if peer is None or not peer.is_next or not record.stage is peer.stage is Stage.UP:
            return
        if len(self._tables.slots_of(record)) or self._tables.lifetime.closed:
            return
        record.stage, record.late, record.deaths = Stage.CLOSING, False, {None: 0}
        record.recycled += 1
        record.host.close()
        record.give_time(self._tables.clock())
        self._note_change()
        text = "entry %r: a worker of %.0f MB was replaced by a new one (recycle)"
        _log.info(text, record.config.name, record.resident_mb)

    def note_closed(self, record: HostRecord) -> None:
        """Note that the worker of a host has closed, or has died with a next one in the peer."""
        assert record.peer is not None
        record.stage, record.start_by, record.restart_at = Stage.CLOSED, None, None
        record.deaths, record.peer.is_next = {}, False
        # It may have ended before it was killed, and nothing of that concerns the next one here.
        record.dying, record.is_hung = False, False
        record.abort_by, record.aborted_slot = {}, None
        self._note_change()

    def give_back(self, record: HostRecord) -> None:
        """Let the worker before go on with all envs, as the next one could not be started.

        One that was up has played episodes since, which must not be played again.
        """
        peer = record.peer
        if peer is None or not record.is_next or peer.stage is not Stage.UP:
            return
        if record.last_loss is not None:
            return
        requests, slots = self._tables.requests, self._tables.slots_of(record)
        count = len(requests.owed(slots))
        requests.in_flight[record.host.host_id] -= count
        requests.in_flight[peer.host.host_id] += count
        self._move(peer, slots.tolist())
        held, record.held = record.held, []
        for entries, arguments in held:
            peer.host.submit(entries, arguments)

    def inherits(self, record: HostRecord) -> bool:
        """Give all envs of a worker that has died to the next one; False if there is none."""
        peer = record.peer
        if peer is None or not peer.is_next:
            return False
        self._move(peer, self._tables.slots_of(record).tolist())
        peer.deaths |= record.deaths
        peer.culprit = record.culprit
        peer.restarts += 1  # Here it is one.
        self.note_closed(record)
        return True
