"""`Renewals`: replaces workers before they fail (`EnvConfig.recycle`), one env after the other.

Each host of such an entry has a peer with the same slots, and one of the two has a worker. When
that is to be replaced, the peer starts the next. Each env goes over when its episode has ended, so
that none waits for the others, and the worker that has no env left is closed.
Left out: when that is (see `hosts.running.renewal`).
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rlightning_aio._core.group.state.conditions import RENEWAL
from rlightning_aio._core.group.state.host_record import Stage

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables

__all__ = ["Renewals"]

_log = logging.getLogger("rlightning_aio")


class Renewals:
    """See the module.

    Args:
        tables: of the group.
        launch: starts the worker of a host that has been started before.

    Attributes:
        in_progress: a worker starts or closes, so `Supervisor.check` must look at the time.
        on_move: gets a host, and the slots that it has from now on.
    """

    def __init__(self, tables: Tables, launch: Callable[[HostRecord], None]) -> None:
        self._tables = tables
        self._launch = launch
        self.in_progress = False
        self.on_move: Callable[[int, Sequence[int]], None]

    def _move(self, record: HostRecord, slots: Sequence[int]) -> None:
        """Give envs to a host."""
        self._tables.requests.hosts[slots] = record.host.host_id
        self.on_move(record.host.host_id, slots)

    def start_ahead(self, host_id: int, resident_mb: float) -> None:
        """Start the next worker of a host, unless the entry has one that waits for its envs."""
        record = self._tables.records[host_id]
        record.is_due = True
        self._note_memory(record, resident_mb)
        self._start_one_ahead(record.config.name)

    def _start_one_ahead(self, entry: str) -> None:
        own = [r for r in self._tables.records if r.config.name == entry and r.is_due]
        peers = [record.peer for record in own if record.peer is not None]
        if any(p.stage in _SERVING and not len(self._tables.slots_of(p)) for p in peers):
            return
        for peer in peers:
            if peer.stage is Stage.CLOSED:
                self._start(peer)
                return

    def _start(self, record: HostRecord) -> None:
        assert record.peer is not None
        record.started, record.order = record.peer.started, record.peer.order
        record.peer.is_leaving = True
        record.deaths = {}
        record.stage = Stage.DOWN
        self._launch(record)
        self.note_change()

    @staticmethod
    def is_first_start(record: HostRecord) -> bool:
        """Return True if a worker starts as the next of a live one, which counts as no restart."""
        peer = record.peer
        return peer is not None and peer.is_leaving and not record.deaths

    def take_over(self, host_id: int, slot: int, resident_mb: float) -> int:
        """Give an env whose episode has ended to the next worker; return its host.

        That is the host it had where no other can take it now: its peer still has envs of the
        worker before, or can't be started.
        """
        record = self._tables.records[host_id]
        peer = record.peer
        self._note_memory(record, resident_mb)
        if peer is None or peer.stage is Stage.GIVEN_UP:
            return host_id
        if peer.is_leaving and len(self._tables.slots_of(peer)):
            return host_id
        if peer.stage is Stage.CLOSED:
            self._start(peer)
        record.waits += peer.is_down
        self._move(peer, [slot])
        self._start_one_ahead(record.config.name)
        return peer.host.host_id

    def close_if_left(self, record: HostRecord) -> None:
        """Close the worker of a host if all its envs have gone over, and the next one is up."""
        peer = record.peer
        if peer is None or peer.stage is not Stage.UP or record.stage is not Stage.UP:
            return
        if not record.is_leaving or len(self._tables.slots_of(record)):
            return
        record.stage, record.is_due, record.is_leaving = Stage.CLOSING, False, False
        record.recycled += 1
        record.close_by = self._tables.clock() + record.close_seconds
        record.host.close()
        self.note_change()
        text = "entry %r: a worker of %.0f MB was replaced by a new one (recycle)"
        _log.info(text, record.config.name, record.resident_mb)

    def note_closed(self, record: HostRecord) -> None:
        """Note that a worker has closed; start the next one if that is asked for already."""
        record.stage, record.close_by, record.dying = Stage.CLOSED, None, False
        if len(self._tables.slots_of(record)):
            self._start(record)
        self._start_one_ahead(record.config.name)
        self.note_change()

    def inherits(self, record: HostRecord) -> bool:
        """Give all envs of a worker that has died to the next one; False if there is none."""
        peer = record.peer
        if peer is None or not record.is_leaving or peer.stage not in _SERVING:
            return False
        self._move(peer, self._tables.slots_of(record).tolist())
        peer.deaths |= record.deaths
        record.deaths, record.stage = {}, Stage.CLOSED
        record.is_due = record.is_leaving = False
        record.restarts += 1
        return True

    def gives_back(self, record: HostRecord) -> bool:
        """Let the worker before go on, as the next one can't be started; False if it can't."""
        peer = record.peer
        if peer is None or not peer.is_leaving or peer.stage is not Stage.UP:
            return False
        requests, slots = self._tables.requests, self._tables.slots_of(record)
        count = len(requests.owed(slots))
        requests.in_flight[record.host.host_id] -= count
        requests.in_flight[peer.host.host_id] += count
        self._move(peer, slots.tolist())
        held, record.held = record.held, []
        for entries, arguments in held:
            peer.host.submit(entries, arguments)
        record.deaths, record.stage, peer.is_leaving = {}, Stage.CLOSED, False
        self.note_change()
        return True

    def note_change(self) -> None:
        """Note that a host of an entry that is recycled has come to another stage."""
        self.in_progress = any(
            record.peer is not None and record.is_down for record in self._tables.records
        )
        self._tables.conditions.note(RENEWAL, self.in_progress)

    @staticmethod
    def _note_memory(record: HostRecord, resident_mb: float) -> None:
        record.resident_mb = max(record.resident_mb, resident_mb)


_SERVING = (Stage.UP, Stage.DOWN, Stage.REBUILDING)
