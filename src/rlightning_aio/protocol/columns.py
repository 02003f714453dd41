"""Spaces as columns: memory of fixed size for values, and functions that write and read them.

A tree (`rlightning_aio.trees`) has the structure of its space: an array for Box, Discrete,
MultiBinary and MultiDiscrete, a dict for Dict, a tuple for Tuple. The first axis of each array is
that of rows.
Absent on purpose: Text, Sequence, Graph and other spaces without a fixed size; their values are
pickled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rlightning_aio.trees import as_array, is_dict, is_tuple, key_of, mapped, tree_of, walked

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.trees import Node, Path, Tree

Rows: TypeAlias = "slice | NDArray[np.intp]"
"""A selection of rows: a slice for a contiguous range, else an index array."""

_FIXED = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)


@dataclass(frozen=True, slots=True)
class Leaf:
    """One array of a tree: its path, and the shape and dtype of one row."""

    path: Path
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def name(self) -> str:
        """The path in Python's notation; empty for a space of one array."""
        return in_brackets(self.path)


def in_brackets(path: Path) -> str:
    """Write the keys that lead to an array in Python's notation."""
    return "".join(f"[{key!r}]" for key in path)


def leaves(space: gym.Space[Any]) -> tuple[Leaf, ...] | None:
    """Arrays of a value of `space`, or None if it has no fixed size."""
    found = list(walked(tree_of(space)))
    if not all(is_array(part) and part.dtype != object for _, part in found):
        return None
    return tuple(Leaf(path, part.shape, part.dtype) for path, part in found)


def structure(space: gym.Space[Any], *, limits: bool = False) -> object:
    """A key that is equal for spaces whose values become columns in the same way.

    With `limits`, boxes that are bounded in different places differ.
    """

    def of_array(part: gym.Space[Any]) -> object:
        if not is_array(part):
            return type(part).__qualname__
        bounded = (
            (part.bounded_below, part.bounded_above)
            if limits and hasattr(part, "bounded_below")
            else ()
        )
        return part.shape, part.dtype, *(where.tobytes() for where in bounded)

    tree = tree_of(space)
    # Columns are laid out in the order of the keys.
    return key_of(tree, of_array), *(path for path, _ in walked(tree))


def is_array(space: gym.Space[Any]) -> TypeGuard[spaces.Box[Any]]:
    """Return True if all values of `space` are arrays with the same shape and dtype."""
    return isinstance(space, _FIXED)


def assemble(space: gym.Space[Any], arrays: Iterator[Any]) -> Tree:
    """Arrange `arrays`, or others, given in the order of `leaves`, in the structure of `space`."""
    return mapped(lambda _: next(arrays), tree_of(space))


def leaf_of(space_leaves: Sequence[Leaf], tree: Tree) -> Iterator[tuple[Leaf, NDArray[Any]]]:
    """Yield each leaf with its array in `tree`."""
    for leaf in space_leaves:
        array = tree
        for key in leaf.path:
            array = array[key]
        yield leaf, array


def gather(tree: Node, rows: Rows) -> Any:
    """Copy `rows` of each array."""
    if isinstance(tree, np.ndarray):
        return tree[rows].copy() if isinstance(rows, slice) else tree.take(rows, axis=0)
    return mapped(lambda array: gather(array, rows), tree)


class Misfit(ValueError):
    """A value doesn't fit its declared space."""


def out_of_range(array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[np.bool_] | None:
    """Mask of the numbers of `array` that don't fit the integer `dtype`; None if all fit."""
    if dtype.kind not in "iu" or not array.size or np.can_cast(array.dtype, dtype):
        return None
    limits = np.iinfo(dtype)
    if array.min() >= limits.min and array.max() <= limits.max:
        return None
    return (array < limits.min) | (array > limits.max)


def fitted(value: Any, leaf: Leaf, what: str) -> NDArray[Any]:
    """Convert `value` to an array that can be copied into one row of `leaf`.

    Raises:
        Misfit: it has another shape, another kind of dtype, or numbers out of range.
    """
    try:
        array = as_array(value)
    except ValueError:  # Parts of different shapes.
        array = np.asarray(None)
    if array.shape != leaf.shape or not np.can_cast(array.dtype, leaf.dtype, "same_kind"):
        found = f"shape {array.shape} and dtype {array.dtype}"
        if array.dtype == object and type(value) is not np.ndarray:
            found = "None" if value is None else f"a value of type {type(value).__name__}"
        raise Misfit(
            f"{what}{leaf.name} doesn't fit its space: expected shape {leaf.shape} and dtype "
            f"{leaf.dtype}, found {found}"
        )
    beyond = out_of_range(array, leaf.dtype)
    if beyond is not None:
        raise Misfit(
            f"{what}{leaf.name} doesn't fit its space: it holds {array[beyond][0]}, which is out "
            f"of the range of {leaf.dtype}"
        )
    return array


def fitted_tree(
    space: gym.Space[Any],
    value: Any,
    what: str,
    path: Path = (),
) -> Tree:
    """Convert `value` to arrays with the shapes and dtypes of `space`, without needless copies.

    Raises:
        Misfit: see `row_writer`.
    """
    if type(value) is np.ndarray and value.shape == space.shape and value.dtype == space.dtype:
        return value
    if is_dict(space):
        check_keys(value, space.spaces.keys(), what, path)
        parts = space.spaces.items()
        return {k: fitted_tree(inner, value[k], what, (*path, k)) for k, inner in parts}
    if is_tuple(space):
        check_length(value, len(space.spaces), what, path)
        return tuple(
            fitted_tree(inner, part, what, (*path, position))
            for position, (inner, part) in enumerate(zip(space.spaces, value, strict=True))
        )
    assert is_array(space)
    return fitted(value, Leaf(path, space.shape, space.dtype), what).astype(space.dtype)


def check_keys(value: Any, keys: Collection[str], what: str, path: Path = ()) -> None:
    """Raise `Misfit` if `value` is no dict with these keys."""
    if not hasattr(value, "keys") or value.keys() != keys:
        raise _misplaced(what, path, f"a dict with keys {sorted(map(str, keys))}", value)


def check_length(value: Any, length: int, what: str, path: Path) -> None:
    """Raise `Misfit` if `value` is no tuple or list of this length."""
    if not isinstance(value, tuple | list) or len(cast("list[Any]", value)) != length:
        raise _misplaced(what, path, f"a tuple of {length}", value)


def _misplaced(what: str, path: Path, expected: str, value: Any) -> Misfit:
    found = f"keys {sorted(map(str, value))}" if hasattr(value, "keys") else type(value).__name__
    if isinstance(value, tuple | list):
        found = f"one of {len(cast('list[Any]', value))}"
    place = what + in_brackets(path)
    return Misfit(f"{place} doesn't fit its space: expected {expected}, found {found}")


def row_writer(
    space: gym.Space[Any],
    tree: Tree,
    row: int,
    what: str,
    path: Path = (),
) -> Callable[[Any], None]:
    """Make a function that copies a value of `space` into `row` of `tree`.

    Floats may be narrowed (float64 to float32), as in Gymnasium's vector environments.

    Raises (from the function):
        Misfit: the value has another shape, structure or kind of dtype, or numbers out of range;
            a part of it may have been written.
    """
    if is_dict(space):
        return _dict_writer(space, tree, row, what, path)
    if is_tuple(space):
        return _tuple_writer(space, tree, row, what, path)
    leaf = Leaf(path, tree.shape[1:], tree.dtype)
    if not leaf.shape:
        return _number_writer(tree, row, leaf, what)
    view, shape, dtype = tree[row], leaf.shape, leaf.dtype

    def write(value: Any) -> None:
        if type(value) is not np.ndarray or value.shape != shape or value.dtype is not dtype:
            value = fitted(value, leaf, what)
        view[...] = value

    return write


def _number_writer(column: NDArray[Any], row: int, leaf: Leaf, what: str) -> Callable[[Any], None]:
    def write(value: Any) -> None:
        column[row] = fitted(value, leaf, what)

    return write


def _dict_writer(
    space: spaces.Dict[Any],
    tree: Tree,
    row: int,
    what: str,
    path: Path,
) -> Callable[[Any], None]:
    writers = {
        key: row_writer(inner, tree[key], row, what, (*path, key))
        for key, inner in space.spaces.items()
    }

    def write(value: Any) -> None:
        check_keys(value, writers.keys(), what, path)
        for key, writer in writers.items():
            writer(value[key])

    return write


def _tuple_writer(
    space: spaces.Tuple[Any],
    tree: Tree,
    row: int,
    what: str,
    path: Path,
) -> Callable[[Any], None]:
    writers = [
        row_writer(inner, part, row, what, (*path, position))
        for position, (inner, part) in enumerate(zip(space.spaces, tree, strict=True))
    ]

    def write(value: tuple[Any, ...] | list[Any] | NDArray[Any]) -> None:
        check_length(value, len(writers), what, path)
        for writer, part in zip(writers, value, strict=True):
            writer(part)

    return write


def row_reader(tree: Tree, row: int) -> Callable[[], Any]:
    """Make a function that returns the value in `row` in the form that envs expect: a copy."""

    def of_array(column: NDArray[Any]) -> Callable[[], Any]:
        return (lambda: column[row]) if column.ndim == 1 else column[row].copy

    readers = mapped(of_array, tree)
    return readers if callable(readers) else lambda: mapped(lambda read: read(), readers)
