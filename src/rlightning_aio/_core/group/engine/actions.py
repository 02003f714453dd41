"""Check the actions of a batch and write them into slab rows.

Rule: all or nothing. The whole batch is checked before the first byte is sent. Columns are checked
and copied with vector operations, separate values one by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio._core.group.state.slab_layout import rows_in
from rlightning_aio.batch.data import columns_of_responses
from rlightning_aio.batch.sent import columns_of_values
from rlightning_aio.batch.stacking import plain_numbers
from rlightning_aio.errors import BadAction
from rlightning_aio.protocol.columns import Leaf, Rows, out_of_range
from rlightning_aio.protocol.exchange import FEW_NUMBERS, sum_of_squares
from rlightning_aio.trees import Tree, as_array, index, is_tuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium import spaces
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.slab_layout import SlabLayout
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.protocol.slab import Slab


@dataclass(frozen=True, slots=True)
class OutOfBandSteps:
    """Steps with arguments that the channel carries, by their positions in the batch.

    Each content is an action and extras; None is in the place of an action that is in its row.
    """

    positions: NDArray[np.intp]
    contents: list[tuple[Any, dict[str, Any]]]


def write_actions(
    batch: BatchedData, slots: NDArray[np.intp], envs: EnvTable, layout: SlabLayout
) -> OutOfBandSteps | None:
    """Check the actions of `batch` and write those that travel in rows.

    Returns the steps to send out of band, or None if the rows hold all that is to be sent.

    Raises:
        BadAction: an action doesn't match its env in shape, dtype or count, or holds a number
            outside its space. Nothing was sent; rows of idle envs may have been written.
    """
    beside = envs.actions_beside_rows[slots] if envs.any_beside_rows else None
    columns = columns_of_responses(batch)
    in_rows = beside is None or not np.count_nonzero(beside)
    if columns is not None and len(layout.slabs) == 1 and in_rows:
        rows = rows_in(layout, slots, envs.local)
        write_column(columns.get("action"), layout.slabs[0], slots, rows, envs)
    else:
        if columns is not None and isinstance(columns.get("action"), tuple):
            for slot in slots.tolist():
                _check_tuple(layout.of(slot)[0], slot, envs)
        _write_one_by_one(batch, slots, envs, layout, beside)
    return None if beside is None else _steps_beside_rows(batch, slots, envs, beside)


def _check_tuple(slab: Slab, slot: int, envs: EnvTable) -> None:
    """Refuse a tuple for an env whose action has no parts: they would be taken for columns."""
    space = slab.layout.action_space
    if not is_tuple(space):
        raise BadAction(
            f"a tuple of actions is one of columns, of a Tuple space, but the action space of "
            f"{envs.describe(slot)} is {space}; give a list with one action for each result; "
            "nothing was sent"
        )


def write_column(
    action: Any, slab: Slab, slots: NDArray[np.intp], rows: Rows, envs: EnvTable
) -> None:
    """Write the actions of a whole batch, one copy per leaf of the action space."""
    if isinstance(action, tuple):
        _check_tuple(slab, slots.item(0), envs)
    for leaf, target in slab.action_columns:
        source = _as_array(_column_at(action, leaf) if leaf.path else action)
        if source.shape != (len(slots), *leaf.shape) or not _castable(source, leaf):
            raise BadAction(_misfit(f"the batch's action{leaf.name}", source, leaf, len(slots)))
        if (unfit := _unfit(source, leaf, slab)) is not None:
            raise _unfit_error(unfit, source, leaf, slots, envs)
        target[rows] = source


def number_limits(dtype: np.dtype[Any]) -> dict[np.dtype[Any], float | None]:
    """The dtypes that can be written to a column of `dtype` unconverted.

    Each maps to the limit on the sum of the squares of an action, or None if all numbers fit.
    """
    if dtype.kind != "f":
        return {dtype: None}
    floats = (np.dtype(np.float32), np.dtype(np.float64))
    return {own: _largest(own, dtype)[1] for own in floats}


def _write_one_by_one(
    batch: BatchedData,
    slots: NDArray[np.intp],
    envs: EnvTable,
    layout: SlabLayout,
    beside: NDArray[np.bool_] | None,
) -> None:
    """Write actions given as separate values, or for envs with different layouts.

    Not those of envs whose actions travel `beside` their rows.
    """
    actions = actions_of(batch)
    by_slab: dict[int, list[int]] = {}
    for position, slab_index in enumerate(layout.slab[slots].tolist()):
        if beside is None or not beside[position]:
            by_slab.setdefault(slab_index, []).append(position)
    for slab_index, positions in by_slab.items():
        slab = layout.slabs[slab_index]
        rows = layout.row[slots[positions]]
        for leaf, target in slab.action_columns:
            values = [_at(actions[k], leaf) for k in positions]
            stacked = plain_numbers(values)
            if stacked is None or leaf.shape or not _castable(stacked, leaf):
                sources = [_as_array(value) for value in values]
                for k, source in zip(positions, sources, strict=True):
                    if source.shape != leaf.shape or not _castable(source, leaf):
                        who = envs.describe(int(slots[k]))
                        raise BadAction(_misfit(f"action{leaf.name} for {who}", source, leaf))
                stacked = np.array(sources)
            if (unfit := _unfit(stacked, leaf, slab)) is not None:
                raise _unfit_error(unfit, stacked, leaf, slots[positions], envs)
            target[rows] = stacked


def _unfit_error(
    unfit: NDArray[np.bool_],
    source: NDArray[Any],
    leaf: Leaf,
    slots: NDArray[np.intp],
    envs: EnvTable,
) -> BadAction:
    """The error that names the first of `slots` with an `unfit` number."""
    row = int(unfit.reshape(len(slots), -1).any(axis=1).argmax())
    number = source[row][unfit[row]].flat[0]
    return BadAction(
        f"action{leaf.name} for {envs.describe(int(slots[row]))} holds {number}, which doesn't "
        f"fit the action space, of dtype {leaf.dtype}; nothing was sent"
    )


def _unfit(source: NDArray[Any], leaf: Leaf, slab: Slab) -> NDArray[np.bool_] | None:
    """A mask of the numbers that the space can't hold, or None if there are none.

    These are NaN, numbers outside the range of the dtype, and infinity where the space is bounded.
    Finite numbers outside the bounds are left to the env.
    """
    if leaf.dtype.kind != "f" or source.dtype.kind != "f":
        return out_of_range(source, leaf.dtype)
    most, most_squared = _largest(source.dtype, leaf.dtype)
    if source.size <= FEW_NUMBERS:
        # One multiplication detects NaN, infinity, and any number that may be too large.
        if sum_of_squares(source) <= most_squared:
            return None
    elif source.max() <= most and source.min() >= -most:
        return None
    space = slab.layout.action_space
    for key in leaf.path:
        space = cast("Any", space)[key]
    box = cast("spaces.Box", space)
    infinite = np.isinf(source)
    unfit = (source > most) & (box.bounded_above | ~infinite)
    unfit |= (source < -most) & (box.bounded_below | ~infinite)
    unfit |= np.isnan(source)
    return unfit if unfit.any() else None


@cache
def _largest(one: np.dtype[Any], other: np.dtype[Any]) -> tuple[float, float]:
    """The largest number that both dtypes hold, and its square (itself where that overflows)."""
    most = min(float(np.finfo(one).max), float(np.finfo(other).max))
    return most, most * most if most < 1e100 else most


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


def _steps_beside_rows(
    batch: BatchedData, slots: NDArray[np.intp], envs: EnvTable, beside: NDArray[np.bool_]
) -> OutOfBandSteps | None:
    """The steps of envs whose actions travel `beside` their rows, or that read extras."""
    columns = columns_of_responses(batch)
    reads = envs.reads_extras[slots]
    any_extras = columns is None or len(columns) > 1
    positions: list[int] = np.flatnonzero(beside | reads if any_extras else beside).tolist()
    actions = actions_of(batch) if positions else []
    contents: dict[int, tuple[Any, dict[str, Any]]] = {}
    for k in positions:
        extras = _extras(batch, k) if reads[k] else {}
        if beside[k]:
            contents[k] = _plain(actions[k]), extras
        elif extras:
            contents[k] = None, extras
    if not contents:
        return None
    return OutOfBandSteps(np.array([*contents], np.intp), [*contents.values()])


def response_columns(
    batch: BatchedData, slots: NDArray[np.intp], layout: SlabLayout
) -> Mapping[str, Any]:
    """Return the columns of a batch of responses to `slots`."""
    columns = columns_of_responses(batch)
    if columns is not None:
        return columns
    slabs: set[int] = {*layout.slab[slots].tolist()}
    actions_as_list = any(layout.slabs[k].action is None for k in slabs)
    return columns_of_values(batch.values(), actions_as_list=actions_as_list)


def _extras(batch: BatchedData, position: int) -> dict[str, Any]:
    columns = columns_of_responses(batch)
    if columns is not None:
        return {name: index(c, position) for name, c in columns.items() if name != "action"}
    return batch.values()[position].extras


def _plain(action: Any) -> Any:
    """Convert a tensor to an array, as workers may lack torch."""
    return _as_array(action) if hasattr(action, "detach") else action


def _as_array(value: Any) -> NDArray[Any]:
    try:
        return as_array(value)
    except (ValueError, TypeError, RuntimeError) as error:  # Tensors NumPy can't convert.
        raise BadAction(f"an action is not an array: {error}; nothing was sent") from None


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


def _column_at(action: Any, leaf: Leaf) -> Any:
    """The column of a batch's actions that belongs to `leaf`; lists hold one action per item."""
    if isinstance(action, list) and leaf.path:
        return [_at(one, leaf) for one in cast("list[Tree]", action)]
    return _at(action, leaf)


def _castable(array: NDArray[Any], leaf: Leaf) -> bool:
    return array.dtype == leaf.dtype or np.can_cast(array.dtype, leaf.dtype, "same_kind")


def _misfit(what: str, found: NDArray[Any], leaf: Leaf, rows: int | None = None) -> str:
    shape = leaf.shape if rows is None else (rows, *leaf.shape)
    return (
        f"{what} doesn't fit the action space: expected shape {shape} and dtype {leaf.dtype}, "
        f"found shape {found.shape} and dtype {found.dtype}; nothing was sent"
    )
