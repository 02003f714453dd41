"""Checks values against the bounds of their space.

Rule: nothing here raises, because some simulators violate the bounds that they declare. `columns`
checks structure, shapes and dtypes; values that don't match these are skipped here. So are tensors,
which may be on another device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.protocol.columns import in_brackets
from rlightning_aio.trees import tree_of, walked

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.trees import Path

_NUMBERS = (np.ndarray, np.generic, int, float)


def out_of_bounds(space: gym.Space[Any], value: Any, what: str) -> str | None:
    """Describe the first number of `value` outside the bounds of `space`; None without any."""
    return next(_faults(space, value, what), None)


def _faults(space: gym.Space[Any], value: Any, what: str) -> Iterator[str]:
    for path, part in walked(tree_of(space)):
        bounds, found = _bounds(part), _held(value, path)
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
            yield f"{what}{name} holds {number}, and the space goes from {least} to {most}"


def _held(value: Any, path: Path) -> Any:
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
