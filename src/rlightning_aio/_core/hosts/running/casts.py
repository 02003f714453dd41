"""`Casts`: notes which parts of an env's observations become another dtype in the row.

`columns.fitted` decides what is converted, and how; this only compares what it got with what it
made. Left out: infos, which keep their dtypes, rewards, which are float64, and actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.protocol.columns import fitted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.protocol.columns import Leaf

__all__ = ["Cast", "Casts"]


@dataclass
class Cast:
    """One part of the observation that is converted.

    Attributes:
        part: which it is, in Python's notation.
        found: the dtype that the env returns, or the type of a value that is no array.
        expected: the dtype of its space.
        rounds: some number was not the same afterwards.
    """

    part: str
    found: str
    expected: str
    rounds: bool = False


class Casts:
    """Converts as `fitted` does, and notes each cast once."""

    def __init__(self) -> None:
        self._casts: dict[tuple[str, str], Cast] = {}

    def found(self) -> list[Cast]:
        """Return what was noted until now."""
        return list(self._casts.values())

    def fitted(self, value: Any, leaf: Leaf, what: str) -> NDArray[Any]:
        """Convert a value by `columns.fitted`, and note whether that changes its dtype."""
        array = fitted(value, leaf, what)
        # A number of Python has no dtype of its own, so an int is no cast where its space is int64.
        if array.dtype == leaf.dtype and type(value) not in (list, tuple):
            return array
        part, found = f"{what}{leaf.name}", str(getattr(value, "dtype", type(value).__name__))
        cast = self._casts.setdefault((part, found), Cast(part, found, str(leaf.dtype)))
        cast.rounds |= not np.array_equal(
            array.astype(leaf.dtype), array, equal_nan=array.dtype.kind == "f"
        )
        return array
