"""`Slots`: what the core knows of each env, as one array for each fact.

A slot is an env's position in its group. Facts are arrays so that a batch of thousands
costs a few vector operations; nothing here walks envs one by one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.errors import UnknownEnv
from rlightning_aio.protocol.rings import NUMBER_SHIFT, OP_BITS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.protocol.info import InfoSchema

__all__ = ["BUSY", "IDLE", "READY", "Slots"]

# States. Invariant: a request is sent to an IDLE slot only; a slot is READY from its
# reply until the reply is handed out.
IDLE: Final = 0
BUSY: Final = 1
READY: Final = 2


# A 0-d array: NumPy takes twice as long over a Python int.
_NEXT_NUMBER: Final = np.array(1 << NUMBER_SHIFT)


class Slots:
    """Arrays over the envs of a group.

    Attributes:
        env_ids, configs: of each slot.
        host: host id.
        entry: ring entry of the current request, without its operation; so it also holds the
            request's number.
        state, op: of the current request; owner: 0 for `collect_async`, else the id of the
            call that waits for it; sent_ns: when it was sent.
        slab, row: where its results lie.
        by_frame: actions may not fit the row; reads_extras: responses' extras are read there;
            letters: either is true of any env.
        seed_offset: sub-environments before it; resets_itself: it needs no reset after an end.
        schemas: of its worker.
    """

    def __init__(self, configs: Sequence[EnvConfig], env_ids: Sequence[str]) -> None:
        size = len(env_ids)
        self.configs = list(configs)
        self.env_ids = list(env_ids)
        self._index = {env_id: slot for slot, env_id in enumerate(env_ids)}
        self.all = np.arange(size)
        self.host = np.zeros(size, np.int64)
        self.entry = self.all << OP_BITS
        self.state = np.zeros(size, np.int8)
        self.op = np.zeros(size, np.int8)
        self.owner = np.zeros(size, np.int64)
        self.sent_ns = np.zeros(size, np.int64)
        self.slab = np.zeros(size, np.intp)
        self.row = np.zeros(size, np.intp)
        self.by_frame = np.zeros(size, np.bool_)
        self.reads_extras = np.zeros(size, np.bool_)
        self.letters = False
        self.seed_offset = np.zeros(size, np.int64)
        self.resets_itself = np.zeros(size, np.bool_)
        self.schemas: list[dict[int, InfoSchema]] = [{} for _ in range(size)]

    def __len__(self) -> int:
        return len(self.env_ids)

    def number(self, slot: int) -> int:
        """Number of the current request; 0 before the first."""
        return int(self.entry[slot]) >> NUMBER_SHIFT

    def renumber(self, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """Give the next request of each of `slots` its number; the new entries."""
        entries = self.entry[slots] + _NEXT_NUMBER
        self.entry[slots] = entries
        return entries

    def find(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """Slots of `env_ids`, in their order.

        Raises:
            UnknownEnv: an id is no env's of this group.
        """
        if len(env_ids) == len(self.env_ids) and list(env_ids) == self.env_ids:
            return self.all
        index = self._index
        try:
            return np.array([index[env_id] for env_id in env_ids], np.intp)
        except KeyError as missing:
            raise UnknownEnv(self._unknown(missing.args[0])) from None

    def find_one(self, env_id: str) -> int:
        """Slot of `env_id`; raises `UnknownEnv`."""
        try:
            return self._index[env_id]
        except KeyError:
            raise UnknownEnv(self._unknown(env_id)) from None

    def _unknown(self, env_id: Any) -> str:
        known = ", ".join(self.env_ids[:8]) + (", …" if len(self.env_ids) > 8 else "")
        return f"no env of this group is called {env_id!r}; its envs are {known}"

    def ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots`, in order."""
        env_ids = self.env_ids
        return [env_ids[slot] for slot in slots.tolist()]

    def names(self, slots: NDArray[np.intp]) -> list[str]:
        """Config entries of `slots`, in order."""
        chosen: list[int] = slots.tolist()
        return [self.configs[slot].name for slot in chosen]

    def describe(self, slot: int) -> str:
        """How an error message names the env."""
        config = self.configs[slot]
        return (
            f"env {self.env_ids[slot]!r} (entry {config.name!r}, backend {config.backend}, "
            f"task {config.task!r})"
        )
