"""`Snapshots`: take the state of envs out of them, and put it back.

A restore is a reset to saved states: one request for each env, whose result is its last
observation. `Episodes` knows the places in the episodes; `snapshot_format` has the bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np

from rlightning_aio._core.group.engine.calls import values_of
from rlightning_aio._core.group.state.episodes import Position
from rlightning_aio._core.group.state.snapshot_format import (
    EnvSnapshot,
    check_same,
    identity_of,
    pack,
    unpack,
)
from rlightning_aio.errors import SnapshotError
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.calls import Calls
    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.messages import EnvState


class Snapshots:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        calls: Calls,
        results: Results,
        waiting: Waiting,
    ) -> None:
        self._envs = tables.envs
        self._record_of = tables.record_of
        self._lifetime = tables.lifetime
        self._requests = tables.requests
        self._episodes = tables.episodes
        self._supervisor = supervisor
        self._calls = calls
        self._results = results
        self._waiting = waiting

    def take(self, now: float, env_ids: Sequence[str] | None) -> Procedure[bytes]:
        """See `EnvGroup.snapshot`."""
        slots = self._envs.chosen(env_ids)
        self._check_restorable(slots)
        each: list[int] = slots.tolist()
        send = self._calls.request(
            now, slots, Operation.SNAPSHOT, "snapshot", [()] * len(slots), "nothing"
        )
        # A worker that has replied may die before others reply.
        positions = self._episodes.positions(slots)
        losses = [self._episodes.why_lost(slot) for slot in each]
        ticket, _ = yield from self._waiting.ask(now, slots, send)
        replies = zip(each, positions, losses, values_of(ticket), strict=True)
        snapshots: list[EnvSnapshot] = []
        for slot, position, loss, reply in replies:
            versions, state = cast("EnvState", reply)
            env_id = self._envs.env_ids[slot]
            if state is None or loss is not None:
                why_not = "has no state yet"
                if loss is not None:
                    why_not = f"has lost its episode ({loss.cause})"
                raise SnapshotError(
                    f"env {env_id!r} {why_not}: reset it before its snapshot is taken. What is in "
                    "flight keeps its episode if drain() ends it, and not abort()"
                )
            identity = identity_of(self._envs.configs[slot], self._supervisor.metas[slot])
            snapshots.append(EnvSnapshot(env_id, identity, versions, *position, state))
        return pack(snapshots)

    def _check_restorable(self, slots: NDArray[np.intp]) -> None:
        self._envs.check_local(slots, "take a snapshot of, or restore,")
        each: list[int] = slots.tolist()
        for slot in each:
            if self._record_of(slot).is_hardware:
                raise SnapshotError(
                    f"{self._envs.describe(slot)} moves something real, which a snapshot can't "
                    "restore"
                )

    def restore(
        self, now: float, data: bytes, env_ids: Sequence[str] | None, source: str | None
    ) -> Procedure[tuple[Ticket, NDArray[np.intp]]]:
        """Put envs into saved states, and wait for all of them; return the ticket and the slots."""
        self._lifetime.check_open()
        snapshots = unpack(data)
        if source is None:
            slots = self._slots_for(snapshots, env_ids)
        else:
            slots = self._slots_like(source, env_ids)
            snapshots = [_of_env(source, snapshots)] * len(slots)
        self._check_restorable(slots)
        each: list[int] = slots.tolist()
        for slot, snapshot in zip(each, snapshots, strict=True):
            identity = identity_of(self._envs.configs[slot], self._supervisor.metas[slot])
            check_same(snapshot, identity, self._envs.describe(slot))
        self._waiting.check_sendable(now, slots, "restore")
        states = [(snapshot.versions, snapshot.state) for snapshot in snapshots]
        packed = [
            self._supervisor.packed(slot, state, "its snapshot")
            for slot, state in zip(each, states, strict=True)
        ]
        positions = [Position(snapshot.num_steps, snapshot.is_cut) for snapshot in snapshots]

        def send(ticket: Ticket) -> None:
            self._episodes.note_restores(slots, positions)
            entries = self._requests.issue(slots, Operation.RESTORE, ticket.owner, now)
            self._results.note_unasked(slots)
            self._supervisor.hand_over(slots, entries, packed)

        ticket, _ = yield from self._waiting.ask(now, slots, send)
        return ticket, slots

    def _slots_for(
        self, snapshots: Sequence[EnvSnapshot], env_ids: Sequence[str] | None
    ) -> NDArray[np.intp]:
        """Return the slots of `env_ids`, or else of all envs, if these are what was saved."""
        taken_of = [snapshot.env_id for snapshot in snapshots]
        slots = self._envs.chosen(env_ids)
        if (where := len(slots)) != len(snapshots):
            raise SnapshotError(
                f"the snapshot is of {len(snapshots)} envs, but should go into {where}; "
                "name as many in env_ids, in order; nothing was changed"
            )
        if env_ids is None and (missing := set(taken_of) - set(self._envs.env_ids)):
            raise SnapshotError(
                f"the snapshot is of {min(missing)!r}, and this group has no such env; name in "
                "env_ids where each should go, in order; nothing was changed"
            )
        return self._envs.chosen(taken_of) if env_ids is None else slots

    def _slots_like(self, source: str, env_ids: Sequence[str] | None) -> NDArray[np.intp]:
        """Return the slots of `env_ids`, or else of all envs of the entry of env `source`."""
        if env_ids is not None:
            return self._envs.chosen(env_ids)
        entries = self._envs.names.entries
        return np.flatnonzero(entries == entries[self._envs.find_one(source)])


def _of_env(source: str, snapshots: Sequence[EnvSnapshot]) -> EnvSnapshot:
    for snapshot in snapshots:
        if snapshot.env_id == source:
            return snapshot
    raise SnapshotError(
        f"the snapshot has no state of {source!r}, only of "
        f"{', '.join(snapshot.env_id for snapshot in snapshots)}; nothing was changed"
    )
