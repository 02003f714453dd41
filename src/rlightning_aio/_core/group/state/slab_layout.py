"""`SlabLayout`: the slab and the row of each env.

Local envs get their rows together, after all are built. The first client of an env_server brings a
slab with rows for all of its places. Until then these have no row: row 0 of the first slab, which
is the default, belongs to another env.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.hosts.messages import AttachOrder
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.protocol.slab import Slab, rows_for

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.arena import Arena
    from rlightning_aio._core.hosts.messages import EnvStarted
    from rlightning_aio.protocol.columns import Rows
    from rlightning_aio.types import EnvMeta


def rows_in(layout: SlabLayout, slots: NDArray[np.intp], everyone: NDArray[np.intp]) -> Rows:
    """The rows of `slots` in the only slab; a slice if `slots` is the array `everyone`."""
    if slots is everyone:
        return slice(0, len(slots))
    return slots if layout.row_is_slot else layout.row[slots]


def check_actions(metas: Sequence[EnvMeta]) -> None:
    """Raise `ConfigError` if the actions of envs differ in shape."""
    for meta in metas[1:]:
        first = metas[0]
        if _action_shape(meta) != _action_shape(first):
            raise ConfigError(
                f"envs {first.env_id!r} and {meta.env_id!r} have different action spaces: "
                f"{first.action_space} and {meta.action_space}; if that is meant, build the "
                "group with mixed_actions=True"
            )


def _action_shape(meta: EnvMeta) -> Any:
    """The shapes of an action, without the batch axis."""
    if meta.action_space is None:
        return None
    found = leaves(meta.action_space)
    if found is None:
        # The default repr of a user-defined space contains its address, which differs.
        described = type(meta.action_space).__repr__ is not object.__repr__
        return str(meta.action_space) if described else type(meta.action_space).__qualname__
    skip = 1 if meta.num_envs > 1 else 0
    return [(leaf.path, leaf.shape[skip:]) for leaf in found]


class SlabLayout:
    """The slabs of a group, and the position of each slot in them.

    Attributes:
        slabs: all slabs.
        slab, row: the index of the slab of each slot, and its row there.
        row_is_slot: the row of every slot is the slot itself, so `row` isn't needed.
        num_in_first: the local envs, if all have their rows in the first slab; else 0.
    """

    def __init__(self, size: int) -> None:
        self.slabs: list[Slab] = []
        self.slab = np.zeros(size, np.intp)
        self.row = np.zeros(size, np.intp)
        self.row_is_slot = False
        self.num_in_first = 0
        # Offset in the arena, and number of rows, of each slab there.
        self._parts: list[tuple[int, int]] = []

    def lay_out(self, started: Sequence[EnvStarted], arena: Arena) -> None:
        """Give each local env a row in the slab of its layout.

        Args:
            started: the envs, in the order of their slots.
            arena: holds the memory of the slabs.
        """
        sizes, places = rows_for([env.layout for env in started])
        for slot, place in enumerate(places):
            self.slab[slot], self.row[slot] = place
        for layout, rows in sizes:
            size = layout.size(rows)
            offset = arena.append(size)
            self._parts.append((offset, rows))
            self.slabs.append(Slab(layout, arena.map(offset, size), rows))
        self.num_in_first = len(started) if len(self.slabs) == 1 else 0
        self._note_rows()

    def order_for(self, first_slot: int, num_envs: int, close_seconds: float) -> AttachOrder:
        """The message that gives a host of local envs their rows, and its time to close."""
        slots = range(first_slot, first_slot + num_envs)
        rows = tuple((int(self.slab[slot]), int(self.row[slot])) for slot in slots)
        return AttachOrder(tuple(self._parts), rows, close_seconds)

    def add(self, slab: Slab, first_slot: int) -> None:
        """Add the slab of an env_server, with one row for each of its places in order."""
        slots = slice(first_slot, first_slot + slab.rows)
        self.slab[slots] = len(self.slabs)
        self.row[slots] = np.arange(slab.rows)
        self.slabs.append(slab)
        self._note_rows()

    def _note_rows(self) -> None:
        self.row_is_slot = bool((self.row == np.arange(len(self.row))).all())

    def of(self, slot: int) -> tuple[Slab, int]:
        """The slab and the row of a slot."""
        return self.slabs[self.slab.item(slot)], self.row.item(slot)

    def write_seeds(self, slots: NDArray[np.intp], seeds: NDArray[np.int64]) -> None:
        """Write the seeds of resets into the rows; `NO_SEED` for none."""
        if len(self.slabs) == 1:
            self.slabs[0].seed[self.row[slots]] = seeds + 1
            return
        for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True):
            slab, row = self.of(slot)
            slab.seed[row] = seed + 1

    def release(self) -> None:
        """Drop the slabs; batches that were returned keep the memory that they use."""
        self.slabs.clear()
