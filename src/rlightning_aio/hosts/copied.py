"""Copies values that stay in one process, as if they had travelled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["copied"]


def copied(value: Any) -> Any:
    """`value` with its containers and arrays copied: its maker may change them later.

    Everything else is left as it is; a tensor must stay the tensor it is.
    """
    if isinstance(value, np.ndarray):
        return cast("NDArray[Any]", value).copy()
    if type(value) is dict:
        return {key: copied(inner) for key, inner in cast("dict[Any, Any]", value).items()}
    if type(value) in (tuple, list):
        return type(value)(map(copied, value))
    if hasattr(value, "_make") and not isinstance(value, type):
        return value._make(map(copied, value))  # A named tuple: a graph, for one.
    return value
