"""Views of MuJoCo's memory that need fewer copies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["flat", "joined"]


def flat(view: NDArray[Any]) -> NDArray[Any]:
    """View ``[n, ...]`` as ``[n, values]``, without a copy."""
    if view.ndim == 2:
        return view
    shape, itemsize = (len(view), int(np.prod(view.shape[1:]))), view.itemsize
    return np.lib.stride_tricks.as_strided(view, shape, (view.strides[0], itemsize))


def joined(views: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Views of neighbouring columns as one, so that they are copied in one go."""
    found: list[NDArray[Any]] = []
    for view in views:
        before = found[-1] if found else view
        width = before.shape[1]
        if (
            found
            and before.strides == view.strides
            and view.ctypes.data == (before.ctypes.data + width * before.itemsize)
        ):
            shape = (len(view), width + view.shape[1])
            found[-1] = np.lib.stride_tricks.as_strided(before, shape, view.strides)
        else:
            found.append(view)
    return found
