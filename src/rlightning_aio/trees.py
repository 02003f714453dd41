"""Trees of arrays: an array, or a dict or tuple of trees, as values of Dict and Tuple spaces are.

Anything else in the place of an array is treated as one: a tensor, a space, a list of values. Only
what converts any value, as envs return it, looks into lists, too.
Rule: torch is recognised by name and never imported, so that users without it pay nothing.
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, cast

import numpy as np
from gymnasium import spaces

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

Tree: TypeAlias = Any
"""An array, or a dict or tuple of trees."""
Path: TypeAlias = tuple[Any, ...]
"""The keys of dicts, and positions in tuples, that lead to an array of a tree."""
Node: TypeAlias = "NDArray[Any] | dict[str, Tree] | tuple[Tree, ...]"


def is_dict(space: object) -> TypeGuard[spaces.Dict[Any]]:
    """Return True for a Dict; unlike `isinstance`, this keeps the types of its parts."""
    return isinstance(space, spaces.Dict)


def is_tuple(space: object) -> TypeGuard[spaces.Tuple[Any]]:
    """Return True for a Tuple; unlike `isinstance`, this keeps the types of its parts."""
    return isinstance(space, spaces.Tuple)


def mapped(function: Callable[[Any], Any], tree: Node) -> Tree:
    """Apply `function` to each array of `tree`."""
    if isinstance(tree, dict):
        return {key: mapped(function, inner) for key, inner in tree.items()}
    if isinstance(tree, tuple):
        return tuple(mapped(function, inner) for inner in tree)
    return function(tree)


def zipped(function: Callable[..., Any], tree: Tree, *others: Any) -> Tree:
    """Apply `function` to each array of `tree`, and to what each of `others` has in its place."""
    if isinstance(tree, dict):
        parts = cast("dict[str, Tree]", tree).items()
        return {key: zipped(function, part, *(one[key] for one in others)) for key, part in parts}
    if isinstance(tree, tuple):
        several = cast("tuple[Tree, ...]", tree)
        return tuple(zipped(function, *parts) for parts in zip(several, *others, strict=True))
    return function(tree, *others)


def walked(tree: Tree, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield each array of `tree`, after the keys that lead to it."""
    if isinstance(tree, dict | tuple):
        held = cast("dict[Any, Tree] | tuple[Tree, ...]", tree)
        for key, part in held.items() if isinstance(held, dict) else enumerate(held):
            yield from walked(part, (*path, key))
    else:
        yield path, tree


def key_of(tree: Tree, of_leaf: Callable[[Any], object]) -> object:
    """A key that is equal for trees of one structure whose arrays have equal keys."""
    if isinstance(tree, dict):
        parts = cast("dict[str, Tree]", tree).items()
        return dict, frozenset((key, key_of(part, of_leaf)) for key, part in parts)
    if isinstance(tree, tuple):
        return tuple, *(key_of(part, of_leaf) for part in cast("tuple[Tree, ...]", tree))
    return of_leaf(tree)


def tree_of(space: gym.Space[Any]) -> Tree:
    """Return the spaces that `space` is made of, in the structure of its values."""
    if is_dict(space):
        return {key: tree_of(inner) for key, inner in space.spaces.items()}
    return tuple(map(tree_of, space.spaces)) if is_tuple(space) else space


def stacked(trees: Sequence[Tree]) -> Tree:
    """Stack trees with the same structure along a new first axis; a single one is not copied."""
    if len(trees) == 1:
        return mapped(lambda array: array[None], trees[0])
    return zipped(lambda *arrays: np.stack(arrays), *trees)


def index(tree: Node, position: int) -> Tree:
    """Row `position` of each array: a view, or a NumPy scalar if a row is one number."""
    return tree[position] if isinstance(tree, np.ndarray) else mapped(lambda a: a[position], tree)


def as_array(value: Any) -> NDArray[Any]:
    """Convert `value` to NumPy; tensors are copied to the CPU."""
    if type(value) is np.ndarray:
        return value
    return array_of_tensor(value) if hasattr(value, "detach") else np.asarray(value)


def array_of_tensor(tensor: Any) -> NDArray[Any]:
    """Convert a torch tensor to an array on the CPU; bfloat16, unknown to NumPy, to float32."""
    # Conjugated and negated views are only marked as such, which NumPy can't represent.
    tensor = tensor.detach().cpu().resolve_conj().resolve_neg()
    return (tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy()


def is_tensor(value: Any) -> bool:
    """Return True if `value` is a torch tensor."""
    return type(value).__module__.partition(".")[0] == "torch" and hasattr(value, "detach")


def holds_tensor(value: Any) -> bool:
    """Return True if `value` is a torch tensor, or a dict, tuple or list that holds one."""
    if isinstance(value, dict):
        return any(map(holds_tensor, cast("dict[Any, Any]", value).values()))
    if isinstance(value, tuple | list):
        return any(map(holds_tensor, cast("tuple[Any, ...]", value)))
    return is_tensor(value)


def converted(function: Callable[[Any], Any], value: Any) -> Any:
    """Apply `function` to all that the dicts, tuples and lists of `value` hold, in new ones.

    A dict of another class stays one of that class.
    """
    if isinstance(value, dict):
        held = cast("dict[Any, Any]", value)
        found = {key: converted(function, inner) for key, inner in held.items()}
        if type(held) is dict:
            return found
        other = copy(held)
        for key, inner in found.items():  # A Counter's `update` would add.
            other[key] = inner
        return other
    if type(value) in (tuple, list):
        return type(value)([converted(function, inner) for inner in value])
    if isinstance(value, tuple) and hasattr(cast("Any", value), "_make"):  # A graph, for one.
        return cast("Any", value)._make(converted(function, inner) for inner in cast("Any", value))
    return function(value)


def as_numpy(value: Any) -> Any:
    """Convert every torch tensor in `value` to a NumPy array, without a copy if it is on the CPU.

    Looks into dicts, tuples and lists; returns anything else unchanged.
    """
    if type(value) is np.ndarray:
        return value
    return converted(lambda one: array_of_tensor(one) if is_tensor(one) else one, value)


def copied(value: Any) -> Any:
    """Copy the containers and arrays of `value`, because their owner may change them later.

    Other objects are not copied; a tensor must stay the same tensor.
    """
    return converted(_copied_array, value)


def _copied_array(value: Any) -> Any:
    return cast("NDArray[Any]", value).copy() if isinstance(value, np.ndarray) else value
