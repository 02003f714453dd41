"""Who sits where: each env gets a row in the slab of its layout, all at once at the start."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio.errors import ConfigError
from rlightning_aio.hosts.arena import map_shared
from rlightning_aio.hosts.worker import AttachOrder
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.group.slots import Slots
    from rlightning_aio.hosts.arena import Arena
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.hosts.worker import Started
    from rlightning_aio.types import EnvMeta

__all__ = ["Place", "check_actions", "order_for", "seat"]

Place = tuple[RowLayout, int, int]
"""Layout, rows and offset in the arena of one slab."""


def check_actions(metas: Sequence[EnvMeta]) -> None:
    """Raises `ConfigError` if the envs' actions have different shapes."""
    for meta in metas[1:]:
        first = metas[0]
        if _action_shape(meta) != _action_shape(first):
            raise ConfigError(
                f"envs {first.env_id!r} and {meta.env_id!r} have different action spaces: "
                f"{first.action_space} and {meta.action_space}; if that is meant, build the "
                "group with mixed_actions=True"
            )


def _action_shape(meta: EnvMeta) -> Any:
    """Shapes of an action, without the batch axis."""
    if meta.action_space is None:
        return None
    found = leaves(meta.action_space)
    if found is None:
        return str(meta.action_space)
    skip = 1 if meta.num_envs > 1 else 0
    return [(leaf.path, leaf.shape[skip:]) for leaf in found]


def seat(started: Sequence[Started], table: Slots, arena: Arena) -> tuple[list[Slab], list[Place]]:
    """Give each local env its row, and write down what its requests need.

    Args:
        started: what the workers told of their envs, in the order of their slots.
        table: filled in here.
        arena: takes the slabs.
    """
    keys: dict[tuple[object, ...], int] = {}
    layouts: list[RowLayout] = []
    rows_used: list[int] = []
    for slot, env in enumerate(started):
        slab = keys.setdefault(env.layout.key, len(keys))
        if slab == len(layouts):
            layouts.append(env.layout)
            rows_used.append(0)
        table.slab[slot], table.row[slot] = slab, rows_used[slab]
        rows_used[slab] += 1
        table.by_frame[slot] = env.transforms_actions or env.layout.action_leaves is None
        table.reads_extras[slot] = env.reads_extras
        table.resets_itself[slot] = env.meta.autoreset != "disabled"
        # Seeds are the sub-environments', of which a result may hold some only.
        table.seed_offset[slot] = table.num_seeds
        table.num_seeds += max(env.meta.num_envs, table.configs[slot].num_envs)
    places = [
        (layout, rows, arena.append(layout.size(rows)))
        for layout, rows in zip(layouts, rows_used, strict=True)
    ]
    slabs = [
        Slab(layout, map_shared(arena.descriptor, offset, layout.size(rows)), rows)
        for layout, rows, offset in places
    ]
    return slabs, places


def order_for(host: Host, table: Slots, places: Sequence[Place]) -> AttachOrder:
    """What a host is told of its envs' rows; its slots are made its own."""
    slots = range(host.first_slot, host.first_slot + host.rows)
    schemas: dict[int, Any] = {}
    for slot in slots:
        table.host[slot] = host.host_id
        table.schemas[slot] = schemas
    seats = tuple((int(table.slab[slot]), int(table.row[slot])) for slot in slots)
    return AttachOrder(tuple(places), seats)
