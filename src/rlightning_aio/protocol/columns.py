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

from rlightning_aio.trees import as_array, key_of, mapped, tree_of, walked

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from rlightning_aio.trees import Node, Path, Tree

Rows: TypeAlias = "slice | NDArray[np.intp]"
"""A selection of rows: a slice for a contiguous range, else an index array."""

_NUMBERS = (np.ndarray, np.generic, int, float)
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


def fitted_tree(space: gym.Space[Any], value: Any, what: str) -> Tree:
    """Convert `value` to arrays with the shapes and dtypes of `space`, without needless copies.

    Raises:
        Misfit: see `row_writer`.
    """
    if type(value) is np.ndarray and value.shape == space.shape and value.dtype == space.dtype:
        return value

    def of_array(part: spaces.Box[Any], given: Any, path: Path) -> NDArray[Any]:
        if type(given) is np.ndarray and given.shape == part.shape and given.dtype == part.dtype:
            return given
        return fitted(given, Leaf(path, part.shape, part.dtype), what).astype(part.dtype)

    return placed(of_array, tree_of(space), value, what)


def placed(
    function: Callable[[Any, Any, Path], Any], tree: Tree, value: Any, what: str, path: Path = ()
) -> Tree:
    """Apply `function` to each leaf of `tree`, to what `value` has in its place, and to its path.

    Args:
        function: see above; its results are arranged as `tree` is.
        tree: of a space, in the structure of its values.
        value: should have that structure; lists may be in the place of tuples.
        what: name of the value in messages.
        path: of `tree`.

    Raises:
        Misfit: `value` has another structure.
    """
    if isinstance(tree, dict):
        parts = cast("dict[str, Tree]", tree)
        _check_keys(value, parts, what, path)
        return {k: placed(function, part, value[k], what, (*path, k)) for k, part in parts.items()}
    if isinstance(tree, tuple):
        several = cast("tuple[Tree, ...]", tree)
        _check_length(value, len(several), what, path)
        both = enumerate(zip(several, value, strict=True))
        return tuple(placed(function, part, own, what, (*path, k)) for k, (part, own) in both)
    return function(tree, value, path)


def _check_keys(value: Any, parts: dict[str, Any], what: str, path: Path) -> None:
    if not hasattr(value, "keys") or value.keys() != parts.keys():
        raise _misplaced(what, path, f"a dict with keys {sorted(map(str, parts))}", value)


def _check_length(value: Any, count: int, what: str, path: Path) -> None:
    if not isinstance(value, tuple | list) or len(cast("list[Any]", value)) != count:
        raise _misplaced(what, path, f"a tuple of {count}", value)


def _misplaced(what: str, path: Path, expected: str, value: Any) -> Misfit:
    found = f"keys {sorted(map(str, value))}" if hasattr(value, "keys") else type(value).__name__
    if isinstance(value, tuple | list):
        found = f"one of {len(cast('list[Any]', value))}"
    place = what + in_brackets(path)
    return Misfit(f"{place} doesn't fit its space: expected {expected}, found {found}")


def row_writer(tree: Tree, row: int, what: str, path: Path = ()) -> Callable[[Any], None]:
    """Make a function that copies a value of a space into `row` of `tree`, its columns.

    Floats may be narrowed (float64 to float32), as in Gymnasium's vector environments. Each step
    calls it, so it knows its parts in advance, where `placed` finds them again.

    Raises (from the function):
        Misfit: the value has another shape, structure or kind of dtype, or numbers out of range;
            a part of it may have been written.
    """
    if isinstance(tree, dict):
        parts = cast("dict[str, Tree]", tree)
        by_key = {k: row_writer(part, row, what, (*path, k)) for k, part in parts.items()}

        def write_dict(value: Any) -> None:
            _check_keys(value, by_key, what, path)
            for key, write in by_key.items():
                write(value[key])

        return write_dict
    if isinstance(tree, tuple):
        several = enumerate(cast("tuple[Tree, ...]", tree))
        in_order = [row_writer(part, row, what, (*path, k)) for k, part in several]

        def write_tuple(value: Any) -> None:
            _check_length(value, len(in_order), what, path)
            for write, part in zip(in_order, value, strict=True):
                write(part)

        return write_tuple
    return _array_writer(tree, row, path, what)


def _array_writer(column: NDArray[Any], row: int, path: Path, what: str) -> Callable[[Any], None]:
    leaf = Leaf(path, column.shape[1:], column.dtype)
    view, shape, dtype = column[row, ...], leaf.shape, leaf.dtype

    def write(value: Any) -> None:
        if type(value) is not np.ndarray or value.shape != shape or value.dtype is not dtype:
            value = fitted(value, leaf, what)
        view[...] = value

    return write


def row_reader(tree: Tree, row: int) -> Callable[[], Any]:
    """Make a function that returns the value in `row` in the form that envs expect: a copy."""

    def of_array(column: NDArray[Any]) -> Callable[[], Any]:
        return (lambda: column[row]) if column.ndim == 1 else column[row].copy

    readers = mapped(of_array, tree)
    return readers if callable(readers) else lambda: mapped(lambda read: read(), readers)


# -- bounds. Nothing here raises, because some simulators violate the bounds that they declare.
# Values of another structure, shape or dtype are skipped, and so are tensors, which may be on
# another device.


def out_of_bounds(space: gym.Space[Any], value: Any, what: str) -> str | None:
    """Describe the first number of `value` outside the bounds of `space`; None without any."""
    for path, part in walked(tree_of(space)):
        bounds, found = _bounds(part), held(value, path)
        if bounds is None or not isinstance(found, _NUMBERS):
            continue
        array = np.asarray(found)
        if array.shape != part.shape or array.dtype.kind not in "biuf":
            continue
        low, high = (np.broadcast_to(bound, array.shape) for bound in bounds)
        # In this form NaN is outside.
        outside = ~((array >= low) & (array <= high))
        if outside.any():
            name = in_brackets(path)
            number, least, most = (one[outside][0] for one in (array, low, high))
            return f"{what}{name} holds {number}, and the space goes from {least} to {most}"
    return None


def held(value: Any, path: Path) -> Any:
    """Return what `value` has at `path`; None if it has nothing there, as of an absent agent."""
    for key in path:
        try:
            value = value[key]
        except (LookupError, TypeError):
            return None
    return value


def _bounds(space: gym.Space[Any]) -> tuple[Any, Any] | None:
    # Gymnasium's spaces are generic over dtypes, which aren't known here.
    spaces: Any = gym.spaces
    known = cast("Any", space)
    if isinstance(space, spaces.Box):
        return known.low, known.high
    if isinstance(space, spaces.Discrete):
        return known.start, known.start + known.n - 1
    if isinstance(space, spaces.MultiDiscrete):
        return known.start, known.start + known.nvec - 1
    return (0, 1) if isinstance(space, spaces.MultiBinary) else None
