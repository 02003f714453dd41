"""Ready rows become a batch: a few copies for each slab, none for each env."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.batch import BatchedData, Origin, ResultColumns
from rlightning_aio.protocol.columns import Rows, gather, mapped, stacked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.group.core import Core
    from rlightning_aio.protocol.slab import Slab

__all__ = ["collected"]


def collected(core: Core, slots: NDArray[np.intp], rests: dict[int, Any]) -> BatchedData:
    """A batch of the results of `slots`, which lie in their rows, in the order of `slots`."""
    fleet, table = core.fleet, core.slots
    if len(fleet.slabs) == 1:
        parts = [_part(core, fleet.slabs[0], slots, None, rests)]
    else:
        slabs = table.slab[slots]
        present: list[int] = np.unique(slabs).tolist()
        parts = [
            _part(core, fleet.slabs[slab], slots[places], places, rests)
            for slab in present
            for places in (np.flatnonzero(slabs == slab),)
        ]
    return BatchedData.of_results(parts, Origin(core, slots, table))


def _part(
    core: Core,
    slab: Slab,
    slots: NDArray[np.intp],
    positions: NDArray[np.intp] | None,
    rests: dict[int, Any],
) -> ResultColumns:
    table = core.slots
    rows: Rows
    if slots is table.all:
        rows = slice(0, slab.rows)
    else:
        rows = slots if table.row_is_slot else table.row[slots]
    ends = gather(slab.ends, rows)
    any_ended = np.count_nonzero(ends) > 0
    own_rests, whole = _rests(slots, rests) if rests else ({}, False)
    return ResultColumns(
        slots=slots,
        table=table,
        positions=positions,
        observation=_observations(core, slab, rows, own_rests),
        reward=_copy(slab.reward, rows),
        ends=ends,
        info_marks=_copy(slab.info_mark, rows) if core.info_width else None,
        info=_copy(slab.info[:, : core.info_width], rows) if core.info_width else None,
        schemas=table.schemas,
        rests=own_rests,
        episode_return=_copy(slab.episode_return, rows) if any_ended else None,
        episode_length=_copy(slab.episode_length, rows) if any_ended else None,
        times=gather(slab.times, rows),
        agents=slab.layout.agents,
        observation_space=slab.layout.observation_space,
        whole_results=whole,
    )


def _copy(column: NDArray[Any], rows: Rows) -> NDArray[Any]:
    """Rows of a narrow column: for those, indexing is the quickest copy."""
    return column[rows].copy() if type(rows) is slice else column[rows]


def _observations(core: Core, slab: Slab, rows: Rows, rests: dict[int, Any]) -> Any:
    """Fresh columns; read-only views where the group hands those out and the rows allow it.

    What envs have handed over as it is leaves `rests`; that of one alone isn't copied.
    """
    if slab.observation is None:
        handed_over = slab.layout.observations_apart and len(rests) > 0
        if not handed_over or not all("observation" in rest for rest in rests.values()):
            return None
        return stacked([rest.pop("observation") for rest in rests.values()])
    if not core.zero_copy:
        return gather(slab.observation, rows)
    contiguous = _contiguous(rows)
    if contiguous is None:
        return gather(slab.observation, rows)

    def view(array: NDArray[Any]) -> NDArray[Any]:
        part = array[contiguous]
        part.flags.writeable = False
        return part

    return mapped(view, slab.observation)


def _contiguous(rows: Rows) -> slice | None:
    if isinstance(rows, slice):
        return rows
    if not len(rows):
        return None
    first, last = int(rows[0]), int(rows[-1])
    if last - first + 1 == len(rows) and (np.diff(rows) == 1).all():
        return slice(first, last + 1)
    return None


def _rests(slots: NDArray[np.intp], rests: dict[int, Any]) -> tuple[dict[int, Any], bool]:
    """Take what belongs to `slots`, by row of the batch; and whether some is a whole result."""
    found: dict[int, Any] = {}
    whole = False
    for row, slot in enumerate(slots.tolist()):
        rest = rests.pop(slot, None)
        if rest is not None:
            found[row] = rest
            whole = whole or (type(rest) is dict and "ret" in rest)
    return found, whole
