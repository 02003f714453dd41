"""`Snapshots`: take the state of envs out of them, and put it back.

A restore is all or nothing: it first takes the current state of every env, so that a failure can
be undone. `Continuity` records what the next results then report; `snapshot_format` has the bytes.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio._core.group.engine.calls import values_of
from rlightning_aio._core.group.episodes.continuity import Position
from rlightning_aio._core.group.episodes.snapshot_format import (
    EnvSnapshot,
    check_same,
    identity_of,
    pack,
    unpack,
)
from rlightning_aio._core.hosts.messages import RestoreOrder
from rlightning_aio.errors import EnvFault, SnapshotError, WorkerDied
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.calls import Calls
    from rlightning_aio._core.group.engine.dispatch import Dispatch
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.messages import EnvState

__all__ = ["Snapshots"]

_CANCELLED: Final = Loss("was being restored when that was cancelled", "cancelled", "caller")
_NOT_PUT_BACK: Final = Loss("could not be put back", "not_started", "env")


class Snapshots:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        dispatch: Dispatch,
        calls: Calls,
        waiting: Waiting,
    ) -> None:
        self._envs = tables.envs
        self._supervisor = supervisor
        self._dispatch = dispatch
        self._calls = calls
        self._continuity = tables.continuity
        self._stats = tables.stats
        self._waiting = waiting

    def take(
        self, now: float, env_ids: Sequence[str] | None, *, as_shown: bool
    ) -> Procedure[bytes]:
        """See `EnvGroup.snapshot`; `as_shown`: raise if an env is to resume, and hasn't said so."""
        slots = self._envs.all if env_ids is None else self._dispatch.distinct(env_ids)
        self._check_restorable(slots)
        snapshots, _ = yield from self._take(now, slots, as_shown=as_shown)
        for snapshot, why_not in snapshots:
            if why_not:
                raise SnapshotError(
                    f"env {snapshot.env_id!r} {why_not}: reset it before its snapshot is taken"
                )
        return pack([snapshot for snapshot, _ in snapshots])

    def _check_restorable(self, slots: NDArray[np.intp]) -> None:
        self._dispatch.check_local(slots, "take a snapshot of, or restore,")
        each: list[int] = slots.tolist()
        for slot in each:
            if ENVS.is_hardware(self._envs.configs[slot].backend):
                raise SnapshotError(
                    f"{self._envs.describe(slot)} moves something real, which a snapshot can't "
                    "restore"
                )

    def _take(
        self, now: float, slots: NDArray[np.intp], *, as_shown: bool = False
    ) -> Procedure[tuple[list[tuple[EnvSnapshot, str]], float]]:
        """Take one snapshot per env; return the time, too.

        Each comes with why it is of no episode, or "". Its env itself can go back to it even so.
        """
        op, nothing = Operation.SNAPSHOT, [()] * len(slots)
        each: list[int] = slots.tolist()
        positions: list[Position] = []
        losses: list[Loss | None] = []

        def send(ticket: Ticket) -> None:
            self._calls.send(now, slots, op, nothing, "nothing", ticket)
            # A worker that has replied may die before others reply.
            positions.extend(self._continuity.positions(slots))
            losses.extend(
                self._continuity.why_lost(slot, unless_saved=not as_shown) for slot in each
            )

        ticket, later = yield from self._waiting.ask(now, slots, send, "snapshot")
        replies = zip(each, positions, losses, values_of([ticket]), strict=True)
        snapshots: list[tuple[EnvSnapshot, str]] = []
        for slot, (num_steps, is_cut), loss, reply in replies:
            versions, has_result, checkpoint = cast("EnvState", reply)
            identity = identity_of(self._envs.configs[slot], self._supervisor.metas[slot], versions)
            env_id = self._envs.env_ids[slot]
            why_not = "" if has_result else "has no state yet"
            if has_result and loss is not None:
                why_not = f"has a state whose episode was lost ({loss.cause})"
            snapshot = EnvSnapshot(env_id, identity, num_steps, is_cut, checkpoint)
            snapshots.append((snapshot, why_not))
        return snapshots, later

    def restore(
        self, now: float, data: bytes, env_ids: Sequence[str] | None
    ) -> Procedure[tuple[NDArray[np.intp], list[Position], float]]:
        """Put envs into the state of their snapshots, which a reset `AS_RESTORED` then shows.

        Returns their slots, their positions in their episodes, and the time.
        """
        snapshots = unpack(data)
        slots = self._slots_for(snapshots, env_ids)
        self._check_restorable(slots)
        deaths = self._supervisor.last_losses(slots)
        own_snapshots, now = yield from self._take(now, slots)
        for slot, snapshot, (own, _) in zip(slots.tolist(), snapshots, own_snapshots, strict=True):
            check_same(snapshot, own.identity, self._envs.describe(slot))
        try:
            states = [own.state for own, _ in own_snapshots]
            now = yield from self._restore(now, slots, snapshots, states, deaths)
        except EnvFault:
            raise
        except BaseException:
            self._continuity.lose(slots.tolist(), _CANCELLED)
            self._stats.note_cancelled(slots)
            raise
        positions = [Position(snapshot.num_steps, snapshot.is_cut) for snapshot in snapshots]
        return slots, positions, now

    def _slots_for(
        self, snapshots: Sequence[EnvSnapshot], env_ids: Sequence[str] | None
    ) -> NDArray[np.intp]:
        """Return the slots of `env_ids`, or else of all envs, if these are what was saved."""
        taken_of = [snapshot.env_id for snapshot in snapshots]
        where = len(self._envs.all) if env_ids is None else len(env_ids)
        if where != len(snapshots):
            raise SnapshotError(
                f"the snapshot is of {len(snapshots)} envs, but should go into {where}; "
                "name as many in env_ids, in order; nothing was changed"
            )
        if env_ids is None and (missing := set(taken_of) - set(self._envs.env_ids)):
            raise SnapshotError(
                f"the snapshot is of {min(missing)!r}, and this group has no such env; name in "
                "env_ids where each should go, in order; nothing was changed"
            )
        return self._dispatch.distinct(taken_of if env_ids is None else env_ids)

    def _restore(
        self,
        now: float,
        slots: NDArray[np.intp],
        snapshots: Sequence[EnvSnapshot],
        before: Sequence[bytes],
        deaths: NDArray[Any],
    ) -> Procedure[float]:
        """Load the state of each snapshot; if one fails, load the states from `before` again.

        The envs of a worker that has died since `deaths` were its last can't go back. Returns the
        time.
        """
        states = [RestoreOrder(snapshot.state, show=True) for snapshot in snapshots]
        try:
            self._check_alive(slots, deaths)  # A replacement must not go on where it never was.
            ticket, now = yield from self._load(now, slots, states)
            values_of([ticket])
            self._check_alive(slots, deaths)
        except EnvFault as fault:
            alive = self._supervisor.last_losses(slots) == deaths
            kept = [before[k] for k in np.flatnonzero(alive).tolist()]
            lost = yield from self._undo(now, slots[alive], kept)
            note = "nothing was restored: the other envs are where they were before"
            if lost:
                note += f", but {', '.join(lost)}: to begin a new episode with the next step"
            fault.add_note(note)
            raise
        return now

    def _check_alive(self, slots: NDArray[np.intp], deaths: NDArray[Any]) -> None:
        """Raise a death since `deaths`, of which nobody has heard, as its envs had replied."""
        last = self._supervisor.last_losses(slots)
        for death in last[last != deaths]:
            raise death.silent(slots[last == death])

    def _undo(
        self, now: float, slots: NDArray[np.intp], before: Sequence[bytes]
    ) -> Procedure[list[str]]:
        """Load the states from `before` again; return the ids of envs that can't go back."""
        try:
            own = [RestoreOrder(state, show=False) for state in before]
            ticket, _ = yield from self._load(now, slots, own)
            values_of([ticket])
        except EnvFault as fault:
            # What a death means for its envs is settled.
            faults = [one for one in (fault, *fault.others) if not isinstance(one, WorkerDied)]
            lost = [fault.env_id for fault in faults]
            self._continuity.lose(self._envs.find(lost).tolist(), _NOT_PUT_BACK)
            return lost
        return []

    def _load(
        self, now: float, slots: NDArray[np.intp], states: Sequence[RestoreOrder]
    ) -> Procedure[tuple[Ticket, float]]:
        """Have envs load states."""
        send = partial(self._calls.send, now, slots, Operation.RESTORE, states, "its snapshot")
        return self._waiting.ask(now, slots, send, "restore")
