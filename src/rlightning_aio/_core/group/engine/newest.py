"""`Newest`: which results are still the newest of their envs, for those who keep results.

A `Collector` keeps the results that it has not answered. Until it continues, its program may reset
or restore envs, or step them otherwise; then the kept results are old. Rule: everything is found
out when somebody asks, so an ordinary step pays nothing. Only what resets return to the program is
kept, once somebody is interested, because nobody can ask an env for it again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.group.state.request_states import State
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.contents import any_reset, slots_of_results
from rlightning_aio.errors import RLightningError
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from rlightning_aio._core.group.supervision.members import Members
    from rlightning_aio._core.group.tables import Tables

__all__ = ["Newest", "newest_of"]

_NOTHING: Final = -1, BatchedData(), 0


class Newest:
    """See the module.

    Attributes:
        keeps: the results of resets are kept.
    """

    def __init__(self, tables: Tables, members: Members) -> None:
        self.keeps = False
        self._envs = tables.envs
        self._requests = tables.requests
        self._members = members
        # By slot: the mark, the batch and the row of what a reset has returned.
        self._kept: dict[int, tuple[int, BatchedData, int]] = {}

    def marks(self, batch: BatchedData) -> NDArray[np.int64]:
        """Return a number for the env of each result, which changes with its next step or reset."""
        return self._requests.numbering.of_results(slots_of_results(batch))

    def num_idle(self) -> int:
        """Return the number of slots without a request in flight or a result to be collected."""
        state = self._requests.state
        return len(state) - len(state.nonzero()[0])

    def note_returned(self, batch: BatchedData) -> None:
        """Keep the results of a batch in which envs were reset."""
        slots: list[int] = slots_of_results(batch).tolist()
        marks: list[int] = self.marks(batch).tolist()
        for row in np.flatnonzero(any_reset(batch)).tolist():
            self._kept[slots[row]] = marks[row], batch, row

    def take_returned(self, env_ids: Iterable[str]) -> list[BatchedData]:
        """Return the kept results of some envs, if they are still the newest; forget all others."""
        rows: dict[int, tuple[BatchedData, list[int]]] = {}
        for slot in map(self._envs.find_one, env_ids):
            mark, batch, row = self._kept.get(slot, _NOTHING)
            if self._requests.numbering.of_results(self._requests.alone(slot)).item() == mark:
                rows.setdefault(id(batch), (batch, []))[1].append(row)
        self._kept = {}
        return [batch.take(own) for batch, own in rows.values()]

    def begin_keeping(self) -> None:
        """Keep what resets and restores return from now on, and nothing of before."""
        self.keeps, self._kept = True, {}

    def take_all_returned(self) -> BatchedData | None:
        """Return the newest results of all envs, if one call has returned them to the program."""
        if not self._kept:
            return None
        batches = self.take_returned(self.idle(()))
        is_all = len(batches) == 1 and len(batches[0]) == len(self._members.everyone())
        return batches[0] if is_all else None

    def idle(self, batches: Iterable[BatchedData]) -> list[str]:
        """Return the ids of envs that are here and idle, and have no result in `batches`."""
        wanted = np.zeros(len(self._envs), np.bool_)
        wanted[self._members.everyone()] = True
        wanted &= self._requests.state == State.IDLE
        for batch in batches:
            wanted[slots_of_results(batch)] = False
        return self._envs.names.ids(np.flatnonzero(wanted))

    def check_resettable(self, env_ids: Iterable[str]) -> None:
        """Check that these idle envs may be reset without being asked to.

        Raises:
            RLightningError: an env moves something real, or belongs to a client and so may.
        """
        for env_id in env_ids:
            slot = self._envs.find_one(env_id)
            config = self._envs.configs[slot]
            if slot >= len(self._envs.all) or ENVS.is_hardware(config.backend):
                raise RLightningError(
                    f"{self._envs.describe(slot)} is idle, as it has raised an error or others "
                    "have stepped it; it may move something real, so reset it yourself to go on: "
                    f"group.reset(env_ids=[{env_id!r}])"
                )


def newest_of(group: Any) -> Newest:
    """The `Newest` of an `EnvGroup`, or of the group that is wrapped."""
    return group._core.newest  # noqa: SLF001  # Of this package, and not for users.
