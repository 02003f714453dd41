"""`Shutdown`: the end of a group's hosts: closed in order, or released; disowned after a fork.

Rule: it waits only by yielding a `Wait`. Left out: single deaths, which `Supervisor` handles.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

from rlightning_aio._core.group.drivers.wait import Procedure, Wait
from rlightning_aio._core.group.state.host_record import Stage
from rlightning_aio._core.hosts import times

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables


class Shutdown:
    """See the module."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    def close(self, now: float) -> Procedure[None]:
        """Close all envs, and kill workers that take too long. Idempotent."""
        if self._tables.lifetime.closed:
            return
        self._tables.lifetime.end()
        for record in self._tables.records:
            if record.place is None:  # Clients get a goodbye, as their host closes.
                self._tables.stop_hardware(record.slots)
        alive = [r for r in self._tables.records if r.stage not in (Stage.NEW, Stage.CLOSED)]
        interrupt: KeyboardInterrupt | None = None
        for record in alive:
            record.held, record.restart_at = [], None
            if record.stage is Stage.DOWN:
                record.stage = Stage.CLOSED
            else:
                try:
                    record.host.close()
                except KeyboardInterrupt as error:  # In an env of this process; others close, too.
                    interrupt = error
        try:
            yield from self._until_closed(alive, now)
        finally:
            stuck = any(r.stage not in (Stage.NEW, Stage.CLOSED) for r in self._tables.records)
            self._release(times.GRACE if stuck else times.CLOSE)
        if interrupt is not None:
            raise interrupt

    def _until_closed(self, records: Sequence[HostRecord], now: float) -> Procedure[None]:
        """Wait for hosts that close; kill each when its time is up."""
        by = {r.host.host_id: now + r.close_seconds for r in records}
        killed: set[int] = set()
        now = yield Wait(0.0)
        while still_open := [r for r in records if r.stage is not Stage.CLOSED]:
            for record in still_open:
                host_id = record.host.host_id
                if now < by[host_id]:
                    continue
                if host_id in killed:
                    by[host_id] = math.inf  # A worker that survives ends with its fork server.
                else:
                    record.kill(dump=False)
                    killed.add(host_id)
                    by[host_id] = now + times.GRACE
            until = min(by[r.host.host_id] for r in still_open)
            if until == math.inf:
                return
            now = yield Wait(until)

    def _release(self, seconds: float) -> None:
        for record in self._tables.records:
            record.host.release()
        for shared in self._tables.resources.values():
            shared.release(seconds)
        self._tables.layout.release()
        self._tables.arena.close()

    def disown(self) -> None:
        """Release this process's copies after a fork, without affecting the parent's group."""
        self._tables.lifetime.end()
        for record in self._tables.records:
            if record.killable is not None and record.place is None:
                record.host.release()
        for shared in self._tables.resources.values():
            shared.disown()

    def release(self) -> None:
        """Release everything immediately: the group was garbage-collected without a close."""
        if self._tables.lifetime.closed:
            return
        self._tables.lifetime.end()
        started = any(r.stage is not Stage.NEW for r in self._tables.records)
        seconds = max((record.close_seconds for record in self._tables.records), default=0.0)
        self._release(seconds + times.GRACE)
        if started:
            # The garbage collector calls this, so no caller's line would help.
            warnings.warn(
                "an EnvGroup was not closed; its envs were killed", ResourceWarning, stacklevel=1
            )
