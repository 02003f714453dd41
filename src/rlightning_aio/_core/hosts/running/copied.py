"""Copies values that stay in one process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["copied"]


def copied(value: Any) -> Any:
    """Copy the containers and arrays of `value`, because their owner may change them later.

    Other objects are not copied; a tensor must stay the same tensor.
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
