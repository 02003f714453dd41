"""`States`: takes the state of envs out of them, and puts it back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.errors import EnvFault, SnapshotError, WorkerDied
from rlightning_aio.group.calls import values_of
from rlightning_aio.group.snapshots import EnvSnapshot, check_same, identity_of, pack, unpack
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.group.auto_reset import AutoReset
    from rlightning_aio.group.calls import Calls
    from rlightning_aio.group.dispatch import Dispatch
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.recovery import Recovery
    from rlightning_aio.group.resumption import Resumption
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.group.waiting import Waiting

__all__ = ["States"]


class States:
    """See the module; its arguments are the group's parts."""

    def __init__(
        self,
        envs: EnvTable,
        supervisor: Supervisor,
        dispatch: Dispatch,
        calls: Calls,
        auto: AutoReset,
        recovery: Recovery,
        resumption: Resumption,
        waiting: Waiting,
    ) -> None:
        self._envs = envs
        self._supervisor = supervisor
        self._dispatch = dispatch
        self._calls = calls
        self._auto = auto
        self._recovery = recovery
        self._resumption = resumption
        self._waiting = waiting

    def snapshot(self, now: float, env_ids: Sequence[str] | None) -> Procedure[bytes]:
        """See `EnvGroup.snapshot`."""
        slots = self._envs.all if env_ids is None else self._dispatch.distinct(env_ids)
        self._check_restorable(slots)
        snapshots = yield from self._snapshots(now, slots)
        for snapshot, begun in snapshots:
            if not begun:
                raise SnapshotError(
                    f"env {snapshot.env_id!r} has no state yet: reset it before its snapshot is "
                    "taken"
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

    def _snapshots(
        self, now: float, slots: NDArray[np.intp]
    ) -> Procedure[list[tuple[EnvSnapshot, bool]]]:
        """Of each env what it is and where it stands, and whether it was reset ever."""
        op, nothing = Operation.SNAPSHOT, [()] * len(slots)
        ticket = self._calls.ask(now, slots, op, "snapshot", nothing, "nothing")
        yield from self._waiting.until_replied(ticket)
        each: list[int] = slots.tolist()
        told = zip(each, self._auto.counters(slots), values_of([ticket]), strict=True)
        snapshots: list[tuple[EnvSnapshot, bool]] = []
        for slot, (count, cut), (versions, begun, standing) in told:
            identity = identity_of(self._envs.configs[slot], self._supervisor.metas[slot], versions)
            env_id = self._envs.env_ids[slot]
            snapshots.append((EnvSnapshot(env_id, identity, count, cut, standing), begun))
        return snapshots

    def put_back(
        self, now: float, data: bytes, env_ids: Sequence[str] | None
    ) -> Procedure[NDArray[np.intp]]:
        """Have envs stand where their snapshots do; a reset then shows it. Their slots."""
        snapshots = unpack(data)
        slots = self._slots_for(snapshots, env_ids)
        self._check_restorable(slots)
        # What they are, and the way back, should any of them fail.
        before = yield from self._snapshots(now, slots)
        for slot, snapshot, (own, _) in zip(slots.tolist(), snapshots, before, strict=True):
            check_same(snapshot, own.identity, self._envs.describe(slot))
        yield from self._put_back(now, slots, snapshots, [own.standing for own, _ in before])
        self._auto.restore(slots, [(snapshot.count, snapshot.cut) for snapshot in snapshots])
        self._resumption.note_no_step(slots.tolist())
        return slots

    def _slots_for(
        self, snapshots: Sequence[EnvSnapshot], env_ids: Sequence[str] | None
    ) -> NDArray[np.intp]:
        """The slots of `env_ids`, or else of the envs that the snapshots are of."""
        if env_ids is None:
            env_ids = [snapshot.env_id for snapshot in snapshots]
        if len(env_ids) != len(snapshots):
            raise SnapshotError(
                f"the snapshot is of {len(snapshots)} envs, but should go into {len(env_ids)}; "
                "name "
                "as many in env_ids, in order; nothing was changed"
            )
        return self._dispatch.distinct(env_ids)

    def _put_back(
        self,
        now: float,
        slots: NDArray[np.intp],
        snapshots: Sequence[EnvSnapshot],
        before: Sequence[bytes],
    ) -> Procedure[None]:
        """Have all envs stand where their snapshots do; if any fails, where they stood before.

        One that can't even go back there, and all if this is cancelled, begin anew.
        """
        standings = [(snapshot.standing, True) for snapshot in snapshots]
        try:
            yield from self._send_standings(now, slots, standings)
        except EnvFault as fault:
            failed = {one.env_id for one in (fault, *fault.others) if isinstance(one, WorkerDied)}
            kept = [k for k, slot in enumerate(slots) if self._envs.env_ids[slot] not in failed]
            back = [(before[k], False) for k in kept]
            try:
                yield from self._send_standings(now, slots[kept], back)
            except EnvFault as again:
                lost = {one.env_id for one in (again, *again.others)}
                left = [slot for slot in slots[kept].tolist() if self._envs.env_ids[slot] in lost]
                self._recovery.lose(left, "could not be put back")
            fault.add_note("nothing was restored: the other envs are where they were before")
            raise
        except BaseException:
            self._recovery.lose(slots.tolist(), "was being restored when that was cancelled")
            raise

    def _send_standings(
        self, now: float, slots: NDArray[np.intp], standings: Sequence[tuple[bytes, bool]]
    ) -> Procedure[None]:
        op = Operation.RESTORE
        ticket = self._calls.ask(now, slots, op, "restore", standings, "its snapshot")
        yield from self._waiting.until_replied(ticket)
        values_of([ticket])
