"""Convert torch tensors to NumPy arrays.

Rule: torch is recognised by name and never imported, so users without it pay nothing.
"""

from __future__ import annotations

from typing import Any, cast

from rlightning_aio.protocol.columns import array_of_tensor

__all__ = ["as_numpy", "holds_tensor", "is_tensor"]


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
