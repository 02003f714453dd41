"""Stacks single values, or parts of columns, into columns."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["columns_where_possible", "concatenated", "differing", "stacked_values"]


def stacked_values(values: list[Any]) -> Any:
    """`values` as columns: arrays, torch tensors, and dicts and tuples of them.

    Raises:
        ValueError: they differ in structure or shape.
    """
    first = values[0] if values else None
    if isinstance(first, dict):
        keys = cast("dict[Any, Any]", first).keys()
        if not all(isinstance(value, dict) and value.keys() == keys for value in values):
            raise differing()
        return {key: stacked_values([value[key] for value in values]) for key in keys}
    if isinstance(first, tuple):
        if not all(isinstance(value, tuple) for value in values):
            raise differing()
        tuples = cast("list[tuple[Any, ...]]", values)
        length = len(tuples[0])
        if any(len(value) != length for value in tuples):
            raise differing()
        return tuple(stacked_values([value[k] for value in tuples]) for k in range(length))
    if isinstance(first, str):
        return values
    if type(first).__module__.partition(".")[0] == "torch":
        # A process that holds a tensor has imported torch.
        return sys.modules["torch"].stack(values)
    arrays = [np.asarray(value) for value in values]
    if len({array.shape for array in arrays}) > 1:
        raise differing()
    return np.stack(arrays) if arrays else np.empty(0)


def differing() -> ValueError:
    """What is raised where values of one batch don't stack."""
    return ValueError(
        "envs of this batch have different shapes, so their values don't stack; use by_name()"
    )


def columns_where_possible(values: list[Any]) -> Any:
    """`values` as columns, or as they are where they don't stack."""
    try:
        return stacked_values(values)
    except (ValueError, TypeError, RuntimeError):  # Of tensors: a mixture, shapes.
        return values


def concatenated(trees: list[Any], order: NDArray[np.intp]) -> Any:
    """Trees of one structure behind one another, their rows in another order."""
    first = trees[0]
    if isinstance(first, dict):
        parts = cast("dict[str, Any]", first)
        return {key: concatenated([tree[key] for tree in trees], order) for key in parts}
    if isinstance(first, tuple):
        count = len(cast("tuple[Any, ...]", first))
        return tuple(concatenated([tree[k] for tree in trees], order) for k in range(count))
    if isinstance(first, list):
        rows = [row for tree in trees for row in tree]
        return [rows[k] for k in order.tolist()]
    if isinstance(first, np.ndarray):
        return np.concatenate(trees)[order]
    # A process that holds a tensor has imported torch.
    return sys.modules["torch"].cat(trees)[order]
