"""Checks values against the bounds of their space.

Rule: nothing here raises, because some simulators violate the bounds that they declare. `columns`
checks structure, shapes and dtypes; values that don't match these are skipped here. So are tensors,
which may be on another device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.protocol.columns import Leaf
from rlightning_aio.trees import is_dict, is_tuple

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["out_of_bounds"]

_NUMBERS = (np.ndarray, np.generic, int, float)


def out_of_bounds(space: gym.Space[Any], value: Any, what: str) -> str | None:
    """Describe the first number of `value` outside the bounds of `space`; None without any."""
    return next(_faults(space, value, what, ()), None)


def _faults(
    space: gym.Space[Any], value: Any, what: str, path: tuple[str | int, ...]
) -> Iterator[str]:
    if is_dict(space):
        parts = cast("dict[str, Any]", value) if isinstance(value, dict) else {}
        for key in space.spaces.keys() & parts.keys():
            yield from _faults(space.spaces[key], parts[key], what, (*path, key))
    elif is_tuple(space):
        items = cast("tuple[Any, ...]", value) if isinstance(value, tuple) else ()
        for position, (inner, part) in enumerate(zip(space.spaces, items, strict=False)):
            yield from _faults(inner, part, what, (*path, position))
    elif (bounds := _bounds(space)) is not None and isinstance(value, _NUMBERS):
        array = np.asarray(value)
        if array.shape != space.shape or array.dtype.kind not in "biuf":
            return
        low, high = (np.broadcast_to(bound, array.shape) for bound in bounds)
        # In this form NaN is outside.
        outside = ~((array >= low) & (array <= high))
        if outside.any():
            name = Leaf(path, (), array.dtype).name
            found, least, most = (one[outside][0] for one in (array, low, high))
            yield f"{what}{name} holds {found}, and the space goes from {least} to {most}"


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
