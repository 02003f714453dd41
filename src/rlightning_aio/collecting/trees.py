"""Columns of transitions: arrays, or dicts and tuples of arrays, with rows on their first axis.

`rows_of` converts values of envs and policies to such trees, with one row for each
sub-environment. Storage is allocated once, and read and written by rows.
Absent on purpose: torch. NumPy reads a CPU tensor without copying it.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.trees import Tree, key_of, mapped, walked, zipped

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from numpy.typing import NDArray


def as_column(name: str, value: Any, *, keeps_values: bool = False) -> NDArray[Any]:
    """Convert a value for column `name` to an array; arrays and CPU tensors are not copied.

    A list of Python values (strings, dicts, lists of any length) becomes an array of objects, and
    so does any list if it `keeps_values`: its arrays may have another size the next time.
    """
    if isinstance(value, np.ndarray):
        return cast("NDArray[Any]", value)
    if isinstance(value, list):
        return _listed(cast("list[Any]", value), keeps_values=keeps_values)
    try:
        return np.asarray(value)
    except (TypeError, RuntimeError) as error:  # A tensor on a GPU, or with a gradient.
        raise TypeError(
            f"column {name!r} can't be read as a NumPy array ({error}); give an array, or a tensor "
            "on the CPU without gradient: tensor.detach().cpu()"
        ) from error


def _listed(values: list[Any], *, keeps_values: bool) -> NDArray[Any]:
    is_plain = keeps_values or (values and isinstance(values[0], list | dict | tuple | str))
    if not is_plain:
        try:
            array = np.asarray(values)
        except ValueError:
            array = None
        if array is not None and array.dtype.kind not in "OSU":
            return array
    objects = np.empty(len(values), object)
    objects[:] = values
    return objects


def with_lists(tree: Tree) -> Tree:
    """Replace each array of objects in `tree` by a list."""
    return mapped(lambda leaf: leaf.tolist() if leaf.dtype == object else leaf, tree)


def rows_of(
    columns: Mapping[str, Any], head: tuple[int, ...], plain: Collection[str] = ()
) -> dict[str, Tree]:
    """Reshape columns to one row for each sub-environment: ``[n, *shape]``.

    Args:
        columns: trees of ``[*head, *shape]`` by name.
        head: ``(n,)``, or ``(m, num_envs)``.
        plain: names of those whose lists hold one value for each row, as it is.

    Raises:
        ValueError: the leading axes of a column are not `head`.
        TypeError: a column is a tensor on a GPU or with a gradient.
    """
    rows: dict[str, Tree] = {}
    for name, column in columns.items():
        if type(column) is np.ndarray and len(head) == 1 and column.shape[:1] == head:
            rows[name] = column
        else:
            as_rows = partial(_leaf_rows, name, head, keeps_values=name in plain)
            rows[name] = mapped(as_rows, column)
    return rows


def _leaf_rows(name: str, head: tuple[int, ...], value: Any, *, keeps_values: bool) -> NDArray[Any]:
    array = as_column(name, value, keeps_values=keeps_values)
    shape, depth = array.shape, len(head)
    if shape[:depth] != head:
        raise ValueError(
            f"column {name!r} has shape {list(shape)}; its first "
            f"{'axis' if depth == 1 else 'axes'} must be {list(head)}: one row for each "
            f"{'result' if depth == 1 else 'result and sub-environment'}"
        )
    return array if depth == 1 else array.reshape(-1, *shape[depth:])


def allocated(like: Tree, count: int) -> Tree:
    """Return zeros for `count` rows with the shapes and dtypes of `like`."""
    return mapped(lambda leaf: np.zeros((count, *leaf.shape[1:]), leaf.dtype), like)


def grown(tree: Tree, count: int) -> Tree:
    """Return `tree` extended by zeros to `count` rows."""

    def leaf(array: NDArray[Any]) -> NDArray[Any]:
        larger = np.zeros((count, *array.shape[1:]), array.dtype)
        larger[: len(array)] = array
        return larger

    return mapped(leaf, tree)


def check_alike(columns: Mapping[str, Tree], values: Mapping[str, Tree]) -> None:
    """Check that `values` can be written to rows of the `columns` with the same names.

    Raises:
        ValueError: they differ in shape, structure or kind of dtype.
    """
    for name, rows in values.items():
        column = columns[name]
        if type(rows) is type(column) is np.ndarray and rows.dtype == column.dtype:
            alike = rows.shape[1:] == column.shape[1:]
        else:
            alike = _alike(column, rows)
        if not alike:
            raise ValueError(
                f"column {name!r} has rows of another shape or dtype than before; envs that differ "
                "are collected apart: give one policy for each config entry, as "
                "{'entry name': policy, …}; a policy gives values of several sizes as lists, such "
                "as array.tolist()"
            )


def _alike(tree: Tree, values: Tree) -> bool:
    if key_of(tree, _form) != key_of(values, _form):
        return False
    return all(fits for _, fits in walked(zipped(_castable, tree, values)))


def _form(array: NDArray[Any]) -> object:
    return array.shape[1:]


def _castable(column: NDArray[Any], rows: NDArray[Any]) -> bool:
    return np.can_cast(rows.dtype, column.dtype, "same_kind")


def _keys(tree: Tree) -> Collection[Any]:
    return tree.keys() if hasattr(tree, "keys") else range(len(tree))


# These two recurse for each dict and tuple, not for each array: calls cost more than small copies.


def scattered(tree: Tree, rows: Any, values: Tree) -> None:
    """Write `values` into `rows` of `tree`, which has the same parts and may have others."""
    if isinstance(tree, np.ndarray):
        tree[rows] = values
        return
    for key in _keys(values):
        part = tree[key]
        if type(part) is np.ndarray:
            part[rows] = values[key]
        else:
            scattered(part, rows, values[key])


def gathered(tree: Tree, rows: NDArray[np.intp], out: Tree) -> None:
    """Copy `rows` of `tree` to the first rows of `out`."""
    if isinstance(tree, np.ndarray):
        tree.take(rows, axis=0, out=out[: len(rows)], mode="clip")
        return
    for key in _keys(tree):
        part = tree[key]
        if type(part) is np.ndarray:
            part.take(rows, axis=0, out=out[key][: len(rows)], mode="clip")
        else:
            gathered(part, rows, out[key])
