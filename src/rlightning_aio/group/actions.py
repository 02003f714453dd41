"""Responses become requests: actions are checked and written before anything is sent.

Rule: all or nothing. A batch is looked through as a whole first (in O(1) where it
comes as columns), and only then does the first byte leave. What would cost more than
that, looking at every number, is done only where ``RLIGHTNING_AIO_DEBUG`` is 1.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.batch.data import columns_of_responses
from rlightning_aio.errors import BadAction
from rlightning_aio.hosts.messages import NO_ACTION
from rlightning_aio.protocol.columns import Leaf, Tree, as_array, index

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.slab_layout import SlabLayout
    from rlightning_aio.protocol.slab import Slab

__all__ = ["DEBUG", "OutOfBandSteps", "write_actions"]

DEBUG: Final = os.environ.get("RLIGHTNING_AIO_DEBUG") == "1"
"""Whether actions are searched for NaN, which no action space holds."""


@dataclass(frozen=True, slots=True)
class OutOfBandSteps:
    """What travels out of band: (action, extras) for some positions of a batch."""

    positions: NDArray[np.intp]
    contents: list[tuple[Any, dict[str, Any]]]


def write_actions(
    batch: BatchedData, slots: NDArray[np.intp], envs: EnvTable, layout: SlabLayout
) -> OutOfBandSteps | None:
    """Check the actions of `batch` and write those that fit into their rows.

    Returns what has to be sent out of band, or None if the rows hold all.

    Raises:
        BadAction: an action's shape, dtype or count doesn't fit its env; rows of idle envs
            may have been written, nothing else has happened.
    """
    out_of_band = None
    if envs.any_out_of_band:
        out_of_band = _chosen_out_of_band(batch, slots, envs, layout)
        if out_of_band is not None and len(out_of_band.positions) == len(slots):
            return out_of_band
    columns = columns_of_responses(batch)
    if columns is not None and len(layout.slabs) == 1 and out_of_band is None:
        _write_column(columns.get("action"), layout.slabs[0], slots, envs)
        return None
    _write_one_by_one(batch, slots, envs, layout, out_of_band)
    return out_of_band


def _write_column(action: Any, slab: Slab, slots: NDArray[np.intp], envs: EnvTable) -> None:
    """Write the actions of a whole batch with one copy for each array."""
    rows = slice(None) if slots is envs.all else slots
    for leaf, target in slab.action_columns:
        source = _as_array(_at(action, leaf))
        if source.shape != (len(slots), *leaf.shape) or not _castable(source, leaf):
            raise BadAction(_misfit(f"the batch's action{leaf.name}", source, leaf, len(slots)))
        if DEBUG:
            _refuse_nan(source, leaf, slots, envs)
        target[rows] = source


def _write_one_by_one(
    batch: BatchedData,
    slots: NDArray[np.intp],
    envs: EnvTable,
    layout: SlabLayout,
    out_of_band: OutOfBandSteps | None,
) -> None:
    """Write actions that came as separate values, or for envs of several layouts."""
    elsewhere = set(out_of_band.positions.tolist()) if out_of_band is not None else set[int]()
    actions = actions_of(batch)
    by_slab: dict[int, list[int]] = {}
    for position, slab_index in enumerate(layout.slab[slots].tolist()):
        if position not in elsewhere:
            by_slab.setdefault(slab_index, []).append(position)
    for slab_index, positions in by_slab.items():
        slab = layout.slabs[slab_index]
        rows = layout.row[slots[positions]]
        for leaf, target in slab.action_columns:
            sources = [_as_array(_at(actions[k], leaf)) for k in positions]
            for k, source in zip(positions, sources, strict=True):
                if source.shape != leaf.shape or not _castable(source, leaf):
                    who = envs.describe(int(slots[k]))
                    raise BadAction(_misfit(f"action{leaf.name} for {who}", source, leaf))
            if DEBUG:
                _refuse_nan(np.array(sources), leaf, slots[positions], envs)
            target[rows] = sources


def _refuse_nan(source: NDArray[Any], leaf: Leaf, slots: NDArray[np.intp], envs: EnvTable) -> None:
    if source.dtype.kind not in "fc":
        return
    bad = np.isnan(source).reshape(len(slots), -1).any(axis=1)
    if bad.any():
        who = envs.describe(int(slots[bad.argmax()]))
        raise BadAction(f"action{leaf.name} for {who} holds NaN; nothing was sent")


def actions_of(batch: BatchedData) -> list[Any]:
    """One action for each value of `batch`."""
    columns = columns_of_responses(batch)
    if columns is not None:
        return [index(columns["action"], k) for k in range(len(batch))]
    actions: list[Any] = []
    for id_, value in batch.items():
        if not hasattr(value, "action"):
            raise BadAction(
                f"the value for {id_!r} is a {type(value).__name__}, not a PolicyResponse with an "
                "action"
            )
        actions.append(value.action)
    return actions


def _chosen_out_of_band(
    batch: BatchedData, slots: NDArray[np.intp], envs: EnvTable, layout: SlabLayout
) -> OutOfBandSteps | None:
    """What the channel must carry: actions without a row, and extras that somebody reads."""
    columns = columns_of_responses(batch)
    all_extras = columns is None or len(columns) > 1
    chosen = envs.out_of_band_actions[slots]
    if all_extras:
        chosen = chosen | envs.reads_extras[slots]
    positions = np.flatnonzero(chosen)
    if not len(positions):
        return None
    actions = actions_of(batch)
    contents: list[tuple[Any, dict[str, Any]]] = []
    kept: list[int] = []
    for k in positions.tolist():
        slot = int(slots[k])
        extras = _extras(batch, k) if envs.reads_extras[slot] else {}
        action = actions[k]
        slab = layout.slabs[int(layout.slab[slot])]
        if slab.action is not None and _fits(action, slab):
            if not extras:
                continue
            _write_one(action, slab, int(layout.row[slot]))
            action = NO_ACTION
        elif not envs.out_of_band_actions[slot]:
            continue
        kept.append(k)
        contents.append((_plain(action), extras))
    return OutOfBandSteps(np.array(kept, np.intp), contents) if kept else None


def _extras(batch: BatchedData, position: int) -> dict[str, Any]:
    columns = columns_of_responses(batch)
    if columns is not None:
        return {name: index(c, position) for name, c in columns.items() if name != "action"}
    return batch.values()[position].extras


def _fits(action: Any, slab: Slab) -> bool:
    try:
        return all(
            (array := _as_array(_at(action, leaf))).shape == leaf.shape and _castable(array, leaf)
            for leaf, _ in slab.action_columns
        )
    except (BadAction, ValueError):
        return False


def _write_one(action: Any, slab: Slab, row: int) -> None:
    for leaf, target in slab.action_columns:
        target[row] = _as_array(_at(action, leaf))


def _plain(action: Any) -> Any:
    """A tensor as an array: a worker need not have torch."""
    return _as_array(action) if hasattr(action, "detach") else action


def _as_array(value: Any) -> NDArray[Any]:
    try:
        return as_array(value)
    except ValueError as error:
        raise BadAction(f"an action is no array: {error}; nothing was sent") from None


def _at(tree: Tree, leaf: Leaf) -> Any:
    """The array of `tree` that belongs to `leaf`."""
    for key in leaf.path:
        try:
            tree = tree[key]
        except (KeyError, IndexError, TypeError):
            raise BadAction(
                f"the action has no part {leaf.name}; the action space is a Dict or Tuple"
            ) from None
    return tree


def _castable(array: NDArray[Any], leaf: Leaf) -> bool:
    return array.dtype == leaf.dtype or np.can_cast(array.dtype, leaf.dtype, "same_kind")


def _misfit(what: str, found: NDArray[Any], leaf: Leaf, rows: int | None = None) -> str:
    shape = leaf.shape if rows is None else (rows, *leaf.shape)
    return (
        f"{what} doesn't fit the action space: expected shape {shape} and dtype {leaf.dtype}, "
        f"found shape {found.shape} and dtype {found.dtype}; nothing was sent"
    )
