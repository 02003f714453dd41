"""`Places`: the hosts whose workers start themselves, and the requests that wait for a client.

A place is empty until a client dials in, and again when the client is lost. What is sent to it
meanwhile is held, and is not in flight: nothing executes it, so it counts for no time limit, and no
wait looks at it. `Supervisor` and `Intake` call this; it sends nothing itself.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.group.state.conditions import CLIENTS
from rlightning_aio._core.group.state.host_record import Stage
from rlightning_aio._core.group.state.slab_layout import check_actions
from rlightning_aio.errors import ConfigError, EnvAway, ResetNeeded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.base import Server
    from rlightning_aio._core.hosts.messages import Taken
    from rlightning_aio.types import EnvMeta


class Places:
    """See the module.

    Attributes:
        servers: the listeners, in order; none if the group has no places.
        num_held: the number of requests that wait for clients.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._envs = tables.envs
        self._requests = tables.requests
        self._records: list[HostRecord] = []
        self.servers: list[Server] = []
        self.num_held = 0

    def add(self, record: HostRecord) -> None:
        """Add a place before the start."""
        assert record.place is not None
        self._records.append(record)
        if record.place.server not in self.servers:
            self.servers.append(record.place.server)

    def objection(self, meta: EnvMeta, known: Sequence[EnvMeta]) -> str | None:
        """Return the reason why the env of a client doesn't fit the group, or None.

        Unless the group allows mixed actions, all its actions must have one shape.
        """
        others = [one for one in known if one.action_space is not None]
        try:
            if not self._tables.mixed_actions:
                check_actions([*others[:1], meta])
        except ConfigError as error:
            return str(error)
        return None

    # -- who is there -------------------------------------------------------------

    def take(self, record: HostRecord, taken: Taken) -> None:
        """Note that a client has taken a place."""
        slot = record.slots.start
        assert record.place is not None
        record.place.admit()
        if taken.slab is not None:
            self._tables.layout.add(taken.slab, taken.first_slot)
        self._envs.note_taken(slot, taken.started)
        self._tables.episodes.note_taken(slot)
        record.is_hardware = taken.is_hardware
        record.stage = Stage.UP
        record.idle = ()
        self._note_clients()

    def leave(self, record: HostRecord) -> None:
        """Note that a place is empty."""
        record.stage = Stage.DOWN
        self._tables.episodes.note_empty(record.slots.start)
        self._note_clients()

    def _note_clients(self) -> None:
        is_any_here = any(record.stage is Stage.UP for record in self._records)
        self._tables.conditions.note(CLIENTS, is_any_here)

    def empty(self) -> list[HostRecord]:
        """Return the places without a client."""
        return [record for record in self._records if record.stage is Stage.DOWN]

    @staticmethod
    def late(
        empty: Sequence[HostRecord], since: float, now: float
    ) -> tuple[list[HostRecord], float | None]:
        """Return the places that a call has waited for too long, and when the next one will be
        among them; None for never.
        """
        ends = [since + r.place.server.connect_timeout for r in empty if r.place is not None]
        late = [record for record, end in zip(empty, ends, strict=True) if now >= end]
        return late, min((end for end in ends if now < end < math.inf), default=None)

    def away(self, empty: Sequence[HostRecord]) -> EnvAway:
        """Return the error for a call that has waited for empty places for too long."""
        names = [self._envs.env_ids[record.slots.start] for record in empty]
        servers = dict.fromkeys(r.place.server for r in empty if r.place is not None)
        texts: list[str] = []
        for server in servers:
            here = [f"{client} ({env_id})" for env_id, client in server.sessions.clients().items()]
            texts.append(f"{server.address()} has {', '.join(here) or 'no client'}")
            texts += [f"refused {name!r}: {why}" for name, why in server.sessions.refused.items()]
        texts += [one.last_loss.what for one in empty if one.last_loss is not None]
        seconds = min(server.connect_timeout for server in servers)
        away = EnvAway(
            f"no client has dialled in for {', '.join(names)} within {seconds:g} s "
            f"(env_kwargs.connect_timeout); {'; '.join(texts)}",
            env_id=names[0],
        )
        away.env_ids = tuple(names)
        return away

    # -- steps ------------------------------------------------------------------------

    def check_step(self, slots: NDArray[np.intp]) -> None:
        """Raise an error if any of `slots` is a place that was never reset."""
        for record in self._records_of(slots):
            slot = record.slots.start
            if not record.was_shown:
                raise ResetNeeded(
                    f"{self._envs.describe(slot)} was never reset, so it can't be stepped; "
                    "nothing was sent"
                )

    def _records_of(self, slots: NDArray[np.intp]) -> list[HostRecord]:
        places: list[int] = slots[slots >= self._envs.num_local].tolist()
        return [self._tables.record_of(slot) for slot in places]

    # -- what is held -----------------------------------------------------------------

    def hold(
        self, record: HostRecord, entries: NDArray[np.int64], arguments: Sequence[Any] | None
    ) -> None:
        """Hold the request of the only env, which is not in flight, until a client dials in."""
        record.held.append((entries, arguments))
        self._requests.in_flight[record.host.host_id] -= 1
        self.num_held += 1

    def release(self, record: HostRecord) -> list[tuple[NDArray[np.int64], Sequence[Any] | None]]:
        """Return what a place has held, and count it as in flight."""
        held, record.held = record.held, []
        self._requests.in_flight[record.host.host_id] += len(held)
        self.num_held -= len(held)
        return held

    def held(self) -> dict[int, list[HostRecord]]:
        """Return the places that hold a request, by the owner of that."""
        found: dict[int, list[HostRecord]] = {}
        for record in self._records:
            if record.held:
                owner = self._requests.owner.item(record.slots.start)
                found.setdefault(owner, []).append(record)
        return found

    def drop(self, records: Sequence[HostRecord]) -> NDArray[np.intp]:
        """Take away the requests that places hold; return the slots. None of them is in flight."""
        for record in records:
            self.num_held -= len(record.held)
            record.held = []
            if record.place is not None:
                record.place.drop_reset()
        slots = np.array([record.slots.start for record in records], np.intp)
        for slot in slots.tolist():
            self._tables.episodes.ended_without_result(slot)
        return slots

    def drop_unwanted(self, slots: NDArray[np.intp]) -> None:
        """End those of the held requests of `slots` that belong to nobody."""
        records = [record for record in self._records_of(slots) if record.held]
        if records:
            self._requests.drop_unwanted(self.drop(records))

    def drop_of(self, owner: int) -> None:
        """Drop the held requests of an owner that no longer waits for them."""
        if records := self.held().get(owner):
            self._requests.drop(self.drop(records))
