"""`Slots`: what the core knows of each env, as one array for each fact.

A slot is an env's position in its group. Facts are arrays so that a batch of thousands
costs a few vector operations; nothing here walks envs one by one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.errors import UnknownEnv
from rlightning_aio.protocol.rings import NUMBER_SHIFT, OP_BITS, OP_MASK

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


# 0-d arrays: NumPy takes twice as long over a Python int.
_WITHOUT_OP: Final = np.array(~OP_MASK)
_OP: Final = np.array(OP_MASK)
_NEXT: Final = {op: np.array((1 << NUMBER_SHIFT) + op) for op in range(1, 5)}
"""To be added to an entry without an operation."""


class Slots:
    """Arrays over the envs of a group.

    Local envs come first, then so many slots for each env_server as it may have clients.

    Args:
        configs, env_ids: of the local envs.
        servers: id, config and number of slots of each env_server.

    Attributes:
        env_ids, configs: of each slot; the id of a slot that no client has taken is empty.
        local_ids, server_ids: of the local envs, and of the env_servers.
        all: slots of the local envs.
        host: host id.
        entry: ring entry of the current request: its number, the slot and the operation.
        state: of the current request; owner: 0 for `collect_async`, else the id of the
            call that waits for it; sent_ns: when it was sent.
        slab, row: where its results lie; row_is_slot: of every slot, for which `row` need
            not be asked then.
        by_frame: actions may not fit the row; reads_extras: responses' extras are read there;
            letters: either is true of any env.
        seed_offset: sub-environments before it; num_seeds: those of all local envs.
        resets_itself: it needs no reset after an end; any_resets_itself: true of any env.
        schemas: of its worker.
    """

    def __init__(
        self,
        configs: Sequence[EnvConfig],
        env_ids: Sequence[str],
        servers: Sequence[tuple[str, EnvConfig, int]] = (),
    ) -> None:
        self.local_ids = list(env_ids)
        self.server_ids = [server_id for server_id, _, _ in servers]
        self.configs = list(configs)
        # What a batch calls a slot: a client goes by its server's id there.
        self._batch_ids = list(env_ids)
        for server_id, config, count in servers:
            self.configs += [config] * count
            self._batch_ids += [server_id] * count
        size = len(self.configs)
        self.env_ids = [*env_ids, *[""] * (size - len(env_ids))]
        self._index = {env_id: slot for slot, env_id in enumerate(env_ids)}
        self._each = np.arange(size)
        self.all = self._each[: len(env_ids)]
        self.host = np.zeros(size, np.int64)
        self.entry = np.arange(size) << OP_BITS
        self.state = np.zeros(size, np.int8)
        self.owner = np.zeros(size, np.int64)
        self.sent_ns = np.zeros(size, np.int64)
        self.slab = np.zeros(size, np.intp)
        self.row = np.zeros(size, np.intp)
        self.row_is_slot = False
        self.by_frame = np.zeros(size, np.bool_)
        self.reads_extras = np.zeros(size, np.bool_)
        self.letters = False
        self.seed_offset = np.zeros(size, np.int64)
        self.num_seeds = 0
        self.resets_itself = np.zeros(size, np.bool_)
        self.any_resets_itself = False
        self.schemas: list[dict[int, InfoSchema]] = [{} for _ in range(size)]

    def __len__(self) -> int:
        return len(self.configs)

    def christen(self, slot: int, env_id: str) -> None:
        """Name the client that has taken a server's slot, perhaps from another."""
        self._index.pop(self.env_ids[slot], None)
        self.env_ids[slot] = env_id
        self._index[env_id] = slot

    def alone(self, slot: int) -> NDArray[np.intp]:
        """One slot as an array of slots."""
        return self._each[slot : slot + 1]

    def note_rows(self) -> None:
        """Take note of rows that were given to slots."""
        self.row_is_slot = bool((self.row == self._each).all())

    def note_envs(self) -> None:
        """Take note of what any env does: its requests may not fit a row; it resets itself."""
        self.letters = bool(self.by_frame.any() or self.reads_extras.any())
        self.any_resets_itself = bool(self.resets_itself.any())

    def number(self, slot: int) -> int:
        """Number of the current request; 0 before the first."""
        return int(self.entry[slot]) >> NUMBER_SHIFT

    def op(self, slot: int) -> int:
        """Operation of the current request; 0 before the first."""
        return int(self.entry[slot]) & OP_MASK

    def ops(self, slots: NDArray[np.intp]) -> NDArray[np.int64]:
        """Operations of the current requests of `slots`."""
        return self.entry[slots] & _OP

    def renumber(self, slots: NDArray[np.intp], op: int) -> NDArray[np.int64]:
        """Give the next request of each of `slots` its number; the new entries."""
        if len(slots) == 1:  # As most results come one by one: in a third of the time.
            slot = slots.item()
            entry = self.entry.item(slot)
            self.entry[slot] = (entry & ~OP_MASK) + (1 << NUMBER_SHIFT) + op
            return self.entry[slots]
        entries = self.entry[slots]
        entries &= _WITHOUT_OP
        entries += _NEXT[op]
        self.entry[slots] = entries
        return entries

    def find(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """Slots of `env_ids`, in their order.

        Raises:
            UnknownEnv: an id is no env's of this group.
        """
        if len(env_ids) == len(self.local_ids) and list(env_ids) == self.local_ids:
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
        ids = list(self._index)
        known = ", ".join(ids[:8]) + (", …" if len(ids) > 8 else "")
        return f"no env of this group is called {env_id!r}; its envs are {known}"

    def ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots`, in order."""
        env_ids = self.env_ids
        return [env_ids[slot] for slot in slots.tolist()]

    def batch_ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots` as a batch has them: a client goes by its server's id."""
        chosen: list[int] = slots.tolist()
        return [self._batch_ids[slot] for slot in chosen]

    def names(self, slots: NDArray[np.intp]) -> list[str]:
        """Config entries of `slots`, in order."""
        chosen: list[int] = slots.tolist()
        return [self.configs[slot].name for slot in chosen]

    def describe(self, slot: int) -> str:
        """How an error message names the env."""
        config = self.configs[slot]
        env_id = self.env_ids[slot] or self._batch_ids[slot]
        return (
            f"env {env_id!r} (entry {config.name!r}, backend {config.backend}, "
            f"task {config.task!r})"
        )
