"""Columns of transitions: arrays, or dicts and tuples of arrays, with rows on their first axis.

What comes from an env or a policy becomes such a tree (`rows_of`), with one row for each
sub-environment; what is stored is allocated once, and read and written by rows.
Absent on purpose: torch. A tensor on the CPU is an array that NumPy reads uncopied.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.protocol.columns import Tree, mapped

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

__all__ = ["allocated", "as_column", "check_alike", "gathered", "grown", "rows_of", "scattered"]


def as_column(name: str, value: Any) -> NDArray[Any]:
    """What somebody gave for column `name`, as an array: an array or CPU tensor uncopied.

    Values that don't stack (a list of texts, of dicts) become an array of objects.
    """
    if isinstance(value, np.ndarray):
        return cast("NDArray[Any]", value)
    if isinstance(value, list):
        return _listed(cast("list[Any]", value))
    try:
        return np.asarray(value)
    except (TypeError, RuntimeError) as error:  # Of tensors: a GPU's, or one with a gradient.
        raise TypeError(
            f"column {name!r} can't be read as a NumPy array ({error}); give an array, or a tensor "
            "on the CPU without gradient: tensor.detach().cpu()"
        ) from error


def _listed(values: list[Any]) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError:
        array = None
    if array is not None and array.dtype.kind not in "OSU":
        return array
    objects = np.empty(len(values), object)
    objects[:] = values
    return objects


def rows_of(name: str, tree: Any, head: tuple[int, ...]) -> Tree:
    """Column `name` with one row for each sub-environment: ``[n, *shape]``.

    Args:
        name: for messages.
        tree: ``[*head, *shape]``, or dicts and tuples of such.
        head: ``(n,)``, or ``(m, num_envs)``.

    Raises:
        ValueError: it has not one row for each of `head`.
        TypeError: it is a tensor of a GPU, or one with a gradient.
    """
    if isinstance(tree, (dict, tuple)):
        return mapped(lambda leaf: _leaf_rows(name, leaf, head), cast("Tree", tree))
    return _leaf_rows(name, tree, head)


def _leaf_rows(name: str, value: Any, head: tuple[int, ...]) -> NDArray[Any]:
    array = as_column(name, value)
    shape, depth = array.shape, len(head)
    if shape[:depth] != head:
        raise ValueError(
            f"column {name!r} has shape {list(shape)}; its first "
            f"{'axis' if depth == 1 else 'axes'} must be {list(head)}: one row for each "
            f"{'result' if depth == 1 else 'result and sub-environment'}"
        )
    return array if depth == 1 else array.reshape(-1, *shape[depth:])


def allocated(like: Tree, count: int) -> Tree:
    """Zeros for `count` rows like those of `like`."""
    return mapped(lambda leaf: np.zeros((count, *leaf.shape[1:]), leaf.dtype), like)


def grown(tree: Tree, count: int) -> Tree:
    """The same rows, and further ones up to `count`."""

    def leaf(array: NDArray[Any]) -> NDArray[Any]:
        larger = np.zeros((count, *array.shape[1:]), array.dtype)
        larger[: len(array)] = array
        return larger

    return mapped(leaf, tree)


def check_alike(name: str, tree: Tree, values: Tree) -> None:
    """Whether `values` can be written to rows of `tree`.

    Raises:
        ValueError: they have another shape, structure or kind of number than those before.
    """
    alike = type(values) is type(tree)
    if alike and isinstance(tree, np.ndarray):
        column, rows = cast("NDArray[Any]", tree), cast("NDArray[Any]", values)
        alike = rows.shape[1:] == column.shape[1:]
        if rows.dtype != column.dtype:
            alike = alike and np.can_cast(rows.dtype, column.dtype, "same_kind")
    elif alike:
        alike = _keys(values) == _keys(tree)
    if not alike:
        raise ValueError(
            f"column {name!r} has rows of another shape or dtype than before; envs that differ are "
            "collected apart: give one policy for each config entry, as {'entry name': policy, …}"
        )
    if not isinstance(tree, np.ndarray):
        for key in _keys(tree):
            check_alike(name, tree[key], values[key])


def _keys(tree: Tree) -> Collection[Any]:
    return cast("dict[Any, Tree]", tree).keys() if isinstance(tree, dict) else range(len(tree))


def scattered(tree: Tree, rows: Any, values: Tree) -> None:
    """Write `values` into `rows` of `tree`, which is like them."""
    if isinstance(tree, np.ndarray):
        tree[rows] = values
        return
    for key in _keys(tree):
        scattered(tree[key], rows, values[key])


def gathered(tree: Tree, rows: NDArray[np.intp], out: Tree) -> None:
    """Copy `rows` of `tree` to the front of `out`, which has at least as many."""
    if isinstance(tree, np.ndarray):
        column = cast("NDArray[Any]", tree)
        np.take(column, rows, axis=0, out=out[: len(rows)], mode="clip")
        return
    for key in _keys(tree):
        gathered(tree[key], rows, out[key])
