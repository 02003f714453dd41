"""Trees of arrays: an array, or a dict or tuple of trees, as values of Dict and Tuple spaces are.

Rule: torch is recognised by name and never imported, so that users without it pay nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, cast

import numpy as np
from gymnasium import spaces

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

__all__ = [
    "Node",
    "Tree",
    "array_of_tensor",
    "as_array",
    "as_numpy",
    "holds_tensor",
    "index",
    "is_dict",
    "is_tensor",
    "is_tuple",
    "mapped",
    "paired",
    "stacked",
]

Tree: TypeAlias = Any
"""An array, or a dict or tuple of trees."""
Node: TypeAlias = "NDArray[Any] | dict[str, Tree] | tuple[Tree, ...]"


def is_dict(space: object) -> TypeGuard[spaces.Dict[Any]]:
    """Return True for a Dict; unlike `isinstance`, this keeps the types of its parts."""
    return isinstance(space, spaces.Dict)


def is_tuple(space: object) -> TypeGuard[spaces.Tuple[Any]]:
    """Return True for a Tuple; unlike `isinstance`, this keeps the types of its parts."""
    return isinstance(space, spaces.Tuple)


def mapped(function: Callable[[NDArray[Any]], Any], tree: Node) -> Tree:
    """Apply `function` to each array of `tree`."""
    if isinstance(tree, dict):
        return {key: mapped(function, inner) for key, inner in tree.items()}
    if isinstance(tree, tuple):
        return tuple(mapped(function, inner) for inner in tree)
    return function(tree)


def paired(function: Callable[[Any, Any], Any], one: Node, other: Any) -> Tree:
    """Apply `function` to each array of the tree `one`, and to what `other` has in its place."""
    if isinstance(one, dict):
        return {key: paired(function, inner, other[key]) for key, inner in one.items()}
    if isinstance(one, tuple):
        return tuple(paired(function, inner, other[k]) for k, inner in enumerate(one))
    return function(one, other)


def stacked(trees: Sequence[Node]) -> Tree:
    """Stack trees with the same structure along a new first axis; a single one is not copied."""
    first = trees[0]
    if isinstance(first, dict):
        return {key: stacked([cast("Any", tree)[key] for tree in trees]) for key in first}
    if isinstance(first, tuple):
        return tuple(map(stacked, zip(*cast("Any", trees), strict=True)))
    return first[None] if len(trees) == 1 else np.stack(cast("Any", trees))


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


def as_numpy(value: Any) -> Any:
    """Convert every torch tensor in `value` to a NumPy array, without a copy if it is on the CPU.

    Looks into dicts, tuples and lists; returns anything else unchanged.
    """
    if is_tensor(value):
        return array_of_tensor(value)
    if isinstance(value, dict):
        return {key: as_numpy(inner) for key, inner in cast("dict[Any, Any]", value).items()}
    if type(value) in (tuple, list):
        return type(value)(map(as_numpy, value))
    return value
