"""`Sent`: what a policy attached to requests, given back with the results that answer them.

It never leaves the trainer's process. Each env remembers the columns that its request came
from, and the place there; columns are put together when somebody reads them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio.batch.stacking import columns_where_possible, concatenated
from rlightning_aio.protocol.columns import mapped

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.types import PolicyResponse

__all__ = [
    "Sent",
    "Sources",
    "columns_of_values",
    "joined_sources",
    "kept_columns",
    "taken_sources",
]

Sources: TypeAlias = "tuple[Any, NDArray[np.intp] | None]"
"""For each row the columns it came from (a mapping, or None) and the place there.

Or one mapping (or None) whose rows these are, and None.
"""


def kept_columns(columns: Mapping[str, Any]) -> dict[str, Any]:
    """`columns` as they are now: arrays and tensors are copied, for their maker may go on
    writing to them.
    """
    return {
        name: column.copy() if type(column) is np.ndarray else mapped(_copy, column)
        for name, column in columns.items()
    }


def _copy(leaf: Any) -> Any:
    if isinstance(leaf, np.ndarray):
        return cast("NDArray[Any]", leaf).copy()
    return leaf.clone() if hasattr(leaf, "clone") else list(leaf)


def taken_sources(sources: Sources, rows: list[int]) -> Sources:
    """Those of some rows."""
    columns, places = sources
    if places is None:
        return np.full(len(rows), columns, object), np.array(rows, np.intp)
    return columns[rows], places[rows]


def joined_sources(parts: Sequence[tuple[Sources | None, int]]) -> Sources:
    """Those of several batches, each with its number of rows, one behind the other."""
    columns: list[Any] = []
    places: list[NDArray[np.intp]] = []
    for sources, count in parts:
        own, rows = (None, None) if sources is None else sources
        columns.append(np.full(count, own, object) if rows is None else own)
        places.append(np.arange(count) if rows is None else rows)
    return np.concatenate(columns), np.concatenate(places)


class Sent:
    """Columns by name, as attributes or by ``[]``, in the order of the batch.

    Rows that answer no response (a reset that was asked for, a first result) hold NaN, or 0
    where there is none; `BatchedData.is_reset` is true of them.

    Raises:
        AttributeError, KeyError: nothing of that name was sent for any row.
    """

    def __init__(self, sources: Sources, count: int) -> None:
        columns, rows = sources
        if rows is None:
            rows = np.arange(count)
            columns = np.full(count, columns, object)
        self._columns: NDArray[Any] = columns
        self._rows = rows

    def keys(self) -> list[str]:
        """Names of all columns."""
        return list(dict.fromkeys(name for columns, _ in self._groups() for name in columns or ()))

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __contains__(self, name: object) -> bool:
        return name in self.keys()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)  # As of an object that is still being copied.
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __getitem__(self, name: str) -> Any:
        found: list[Any] = []
        places: list[NDArray[np.intp]] = []
        lacking: list[NDArray[np.intp]] = []
        for columns, where in self._groups():
            if columns is None or name not in columns:
                lacking.append(where)
                continue
            found.append(mapped(lambda leaf, w=where: _rows_of(leaf, self._rows[w]), columns[name]))
            places.append(where)
        if not found:
            known = ", ".join(self.keys()) or "nothing"
            raise KeyError(f"no {name!r} was sent for these results; sent were: {known}")
        if lacking:
            nobody = np.concatenate(lacking)
            found.append(mapped(lambda leaf: _filler(leaf, len(nobody)), found[0]))
            places.append(nobody)
        if len(found) == 1:
            return found[0]
        return concatenated(found, np.argsort(np.concatenate(places)))

    def _groups(self) -> Iterator[tuple[Mapping[str, Any] | None, NDArray[np.intp]]]:
        """The columns that rows came from, each with the places of its rows in the batch."""
        by_source: dict[int, list[int]] = {}
        for place, columns in enumerate(self._columns):
            by_source.setdefault(id(columns), []).append(place)
        for places in by_source.values():
            yield self._columns[places[0]], np.array(places, np.intp)


def _rows_of(leaf: Any, rows: NDArray[np.intp]) -> Any:
    if isinstance(leaf, list):
        values = cast("list[Any]", leaf)
        return [values[row] for row in rows.tolist()]
    return leaf[rows]


def _filler(leaf: Any, count: int) -> Any:
    """As many rows like those of `leaf`, of no meaning."""
    if isinstance(leaf, list):
        return [None] * count
    if isinstance(leaf, np.ndarray):
        array = cast("NDArray[Any]", leaf)
        nothing = np.nan if array.dtype.kind in "fc" else 0
        return np.full((count, *array.shape[1:]), nothing, array.dtype)
    nothing = float("nan") if leaf.is_floating_point() else 0
    return leaf.new_full((count, *leaf.shape[1:]), nothing)


def columns_of_values(values: Sequence[PolicyResponse]) -> dict[str, Any]:
    """Columns of responses that came one by one."""
    extras = (getattr(value, "extras", {}) for value in values)
    names = dict.fromkeys(("action", *(name for own in extras for name in own)))
    return {
        name: columns_where_possible([getattr(value, name, None) for value in values])
        for name in names
    }
