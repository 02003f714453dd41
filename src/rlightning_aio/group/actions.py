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

from rlightning_aio.errors import BadAction
from rlightning_aio.hosts.runner import NO_ACTION
from rlightning_aio.protocol.columns import Leaf, Tree, as_array, index

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.slots import Slots
    from rlightning_aio.protocol.slab import Slab

__all__ = ["DEBUG", "Letters", "write_actions"]

DEBUG: Final = os.environ.get("RLIGHTNING_AIO_DEBUG") == "1"
"""Whether actions are searched for NaN, which no action space holds."""


@dataclass(frozen=True, slots=True)
class Letters:
    """What does not fit the rows: for some positions of a batch (action, extras)."""

    positions: NDArray[np.intp]
    contents: list[tuple[Any, dict[str, Any]]]


def write_actions(
    batch: BatchedData, slots: NDArray[np.intp], table: Slots, slabs: list[Slab]
) -> Letters | None:
    """Check the actions of `batch` and write those that fit into their rows.

    Returns what has to be sent beside, or None if the rows hold all.

    Raises:
        BadAction: an action's shape, dtype or count doesn't fit its env; rows of idle envs
            may have been written, nothing else has happened.
    """
    letters = None
    if table.letters:
        letters = _letters(batch, slots, table, slabs)
        if letters is not None and len(letters.positions) == len(slots):
            return letters
    columns = batch.response_columns
    if columns is not None and len(slabs) == 1 and letters is None:
        _write_column(columns.get("action"), slabs[0], slots, table)
        return None
    _write_one_by_one(batch, slots, table, slabs, letters)
    return letters


def _write_column(action: Any, slab: Slab, slots: NDArray[np.intp], table: Slots) -> None:
    """Write the actions of a whole batch with one copy for each array."""
    rows = slice(None) if slots is table.all else slots
    for leaf, target in slab.action_columns:
        source = _as_array(_at(action, leaf))
        if source.shape != (len(slots), *leaf.shape) or not _castable(source, leaf):
            raise BadAction(_misfit(f"the batch's action{leaf.name}", source, leaf, len(slots)))
        if DEBUG:
            _refuse_nan(source, leaf, slots, table)
        target[rows] = source


def _write_one_by_one(
    batch: BatchedData,
    slots: NDArray[np.intp],
    table: Slots,
    slabs: list[Slab],
    letters: Letters | None,
) -> None:
    """Write actions that came as separate values, or for envs of several layouts."""
    elsewhere = set(letters.positions.tolist()) if letters is not None else set[int]()
    actions = actions_of(batch)
    by_slab: dict[int, list[int]] = {}
    for position, slab_index in enumerate(table.slab[slots].tolist()):
        if position not in elsewhere:
            by_slab.setdefault(slab_index, []).append(position)
    for slab_index, positions in by_slab.items():
        slab = slabs[slab_index]
        rows = table.row[slots[positions]]
        for leaf, target in slab.action_columns:
            sources = [_as_array(_at(actions[k], leaf)) for k in positions]
            for k, source in zip(positions, sources, strict=True):
                if source.shape != leaf.shape or not _castable(source, leaf):
                    who = table.describe(int(slots[k]))
                    raise BadAction(_misfit(f"action{leaf.name} for {who}", source, leaf))
            if DEBUG:
                _refuse_nan(np.array(sources), leaf, slots[positions], table)
            target[rows] = sources


def _refuse_nan(source: NDArray[Any], leaf: Leaf, slots: NDArray[np.intp], table: Slots) -> None:
    if source.dtype.kind not in "fc":
        return
    bad = np.isnan(source).reshape(len(slots), -1).any(axis=1)
    if bad.any():
        who = table.describe(int(slots[bad.argmax()]))
        raise BadAction(f"action{leaf.name} for {who} holds NaN; nothing was sent")


def actions_of(batch: BatchedData) -> list[Any]:
    """One action for each value of `batch`."""
    columns = batch.response_columns
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


def _letters(
    batch: BatchedData, slots: NDArray[np.intp], table: Slots, slabs: list[Slab]
) -> Letters | None:
    """What the channel must carry: actions without a row, and extras that somebody reads."""
    columns = batch.response_columns
    all_extras = columns is None or len(columns) > 1
    chosen = table.by_frame[slots]
    if all_extras:
        chosen = chosen | table.reads_extras[slots]
    positions = np.flatnonzero(chosen)
    if not len(positions):
        return None
    actions = actions_of(batch)
    contents: list[tuple[Any, dict[str, Any]]] = []
    kept: list[int] = []
    for k in positions.tolist():
        slot = int(slots[k])
        extras = _extras(batch, k) if table.reads_extras[slot] else {}
        action = actions[k]
        slab = slabs[int(table.slab[slot])]
        if slab.action is not None and _fits(action, slab):
            if not extras:
                continue
            _write_one(action, slab, int(table.row[slot]))
            action = NO_ACTION
        elif not table.by_frame[slot]:
            continue
        kept.append(k)
        contents.append((_plain(action), extras))
    return Letters(np.array(kept, np.intp), contents) if kept else None


def _extras(batch: BatchedData, position: int) -> dict[str, Any]:
    columns = batch.response_columns
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
