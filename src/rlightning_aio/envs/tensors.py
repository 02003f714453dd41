"""Torch tensors where NumPy arrays are wanted.

Rule: torch is recognised, never imported; a user who has no torch pays for none.
"""

from __future__ import annotations

from typing import Any, cast

from rlightning_aio.protocol.columns import array_of_tensor

__all__ = ["as_numpy", "holds_tensor", "is_tensor"]


def is_tensor(value: Any) -> bool:
    """Whether `value` is a torch tensor."""
    return type(value).__module__.partition(".")[0] == "torch" and hasattr(value, "detach")


def holds_tensor(value: Any) -> bool:
    """Whether `value` is a torch tensor, or a dict, tuple or list that holds one."""
    if isinstance(value, dict):
        return any(map(holds_tensor, cast("dict[Any, Any]", value).values()))
    if isinstance(value, tuple | list):
        return any(map(holds_tensor, cast("tuple[Any, ...]", value)))
    return is_tensor(value)


def as_numpy(value: Any) -> Any:
    """`value` with every torch tensor in it as a NumPy array; a CPU tensor's is no copy.

    Looks into dicts, tuples and lists; anything else is returned as it is.
    """
    if is_tensor(value):
        return array_of_tensor(value)
    if isinstance(value, dict):
        return {key: as_numpy(inner) for key, inner in cast("dict[Any, Any]", value).items()}
    if type(value) in (tuple, list):
        return type(value)(map(as_numpy, value))
    return value
