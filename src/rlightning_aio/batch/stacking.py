"""Stacks single values, or parts of columns, into columns."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.trees import as_array, key_of, zipped

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PLAIN: Final = (int, float, bool)


def plain_numbers(values: list[Any]) -> NDArray[Any] | None:
    """Convert Python's numbers of one type to an array; return None for all else."""
    kinds = set(map(type, values))
    return np.array(values) if len(kinds) == 1 and not kinds.isdisjoint(_PLAIN) else None


def stacked_values(values: list[Any]) -> Any:
    """Stack `values` to columns: arrays, torch tensors, or dicts and tuples of them.

    Tensors among other values become arrays. Texts, and lists that hold any, stay a list: in an
    array they would turn numbers into texts.

    Raises:
        ValueError: they differ in structure or shape.
    """
    first = values[0] if values else None
    if (numbers := plain_numbers(values)) is not None:
        return numbers
    if isinstance(first, dict | tuple):
        return _stacked_trees(cast("dict[Any, Any] | tuple[Any, ...]", first), values)
    if hasattr(first, "detach") and all(hasattr(value, "detach") for value in values):
        # A process that holds a tensor has imported torch.
        return sys.modules["torch"].stack(values)
    arrays = [as_array(value) for value in values]
    kinds = {array.dtype.kind for array in arrays}
    if kinds & {"S", "U"} and (len(kinds) > 1 or not all(map(_is_array, values))):
        return values
    if len({array.shape for array in arrays}) > 1:
        raise differing()
    return np.stack(arrays) if arrays else np.empty(0)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _stacked_trees(first: dict[Any, Any] | tuple[Any, ...], values: list[Any]) -> Any:
    kind, keys = (dict if isinstance(first, dict) else tuple), _keys_of(first)
    if not all(isinstance(value, kind) and _keys_of(value) == keys for value in values):
        raise differing()
    stacked = {key: stacked_values([value[key] for value in values]) for key in keys}
    return stacked if kind is dict else tuple(stacked.values())


def _keys_of(tree: Any) -> Any:
    """Keys of a dict, or positions of a tuple."""
    return cast("dict[Any, Any]", tree).keys() if isinstance(tree, dict) else range(len(tree))


def differing() -> ValueError:
    """The error for values of one batch that don't stack."""
    return ValueError(
        "envs of this batch have different shapes, so their values don't stack; use by_entry()"
    )


def columns_where_possible(values: list[Any]) -> Any:
    """Stack `values` to columns; return them unchanged if they don't stack."""
    try:
        return stacked_values(values)
    except (
        ValueError,
        TypeError,
        RuntimeError,
    ):  # Tensors on several devices, or of several shapes.
        return values


def form_of(tree: Any) -> object:
    """A key that is equal for columns that `concatenated` joins without changing a value."""
    return key_of(tree, _form_of_column)


def _form_of_column(column: Any) -> object:
    if isinstance(column, np.ndarray):
        array = cast("NDArray[Any]", column)
        kind = array.dtype.kind
        return np.ndarray, array.shape[1:], "number" if kind in "biufc" else kind
    if isinstance(column, list):
        return list
    return "tensor", column.shape[1:], str(column.device)


def concatenated(trees: list[Any], order: NDArray[np.intp] | slice = slice(None)) -> Any:
    """Concatenate trees with the same structure, and reorder their rows."""
    return zipped(lambda *columns: _joined(columns, order), *trees)


def _joined(columns: tuple[Any, ...], order: NDArray[np.intp] | slice) -> Any:
    first = columns[0]
    if isinstance(first, list):
        rows = [row for column in columns for row in column]
        return [rows[k] for k in np.arange(len(rows))[order].tolist()]
    if isinstance(first, np.ndarray):
        return np.concatenate(columns)[order]
    # A process that holds a tensor has imported torch.
    return sys.modules["torch"].cat(columns)[order]
