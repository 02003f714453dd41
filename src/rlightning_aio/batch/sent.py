"""`Sent`: a policy's columns, returned with the results that answer them.

They never leave the trainer process. For each env the columns of its request are kept, with its
row there; a column of a batch is assembled when it is read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import numpy as np

from rlightning_aio.batch.stacking import columns_where_possible, concatenated, form_of
from rlightning_aio.trees import index, mapped

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.types import PolicyResponse

UNASKED: Final = -1
"""The row of a result that answers no response."""

Sources: TypeAlias = "tuple[Any, NDArray[np.intp] | None]"
"""For each row of the batch, the columns of its request (a mapping, or None) and its row there.

If that row is `UNASKED`, the columns are those sent last to its entry, as examples. If the batch
answers one request in its order: the mapping of that request, and None.
"""


def copied(column: Any) -> Any:
    """Copy a column: an array, a tensor, a list, or a tree of them."""
    return mapped(_copy, column)


def _copy(leaf: Any) -> Any:
    if isinstance(leaf, np.ndarray):
        return cast("NDArray[Any]", leaf).copy()
    return leaf.clone() if hasattr(leaf, "clone") else list(leaf)


def taken_sources(sources: Sources, rows: list[int]) -> Sources:
    """Select the sources of some rows."""
    columns, places = sources
    if places is None:
        return np.full(len(rows), columns, object), np.array(rows, np.intp)
    return columns[rows], places[rows]


def joined_sources(parts: Sequence[tuple[Sources | None, int]]) -> Sources:
    """Concatenate the sources of several batches, each given with its number of rows."""
    columns: list[Any] = []
    places: list[NDArray[np.intp]] = []
    for sources, count in parts:
        own, rows = (None, None) if sources is None else sources
        columns.append(np.full(count, own, object) if rows is None else own)
        places.append(np.arange(count) if rows is None else rows)
    return np.concatenate(columns), np.concatenate(places)


class Sent:
    """Columns by name, as attributes or by ``[]``, in the order of the batch.

    A column has the form that was sent: an array, a tensor, a dict or tuple of such, or a list with
    one value for each row. If its rows were sent in several forms, it is a list of their values.
    Rows that answer no response (of a reset or a restore) hold NaN, or 0 if the dtype has
    no NaN, or None in a list; their `BatchedData.is_reset` is True. They have the shapes and dtypes
    that were sent last to their config entry. In a batch of only such rows, a name that was never
    sent is a column of NaN.

    Raises:
        AttributeError, KeyError: some rows answer responses, and none of these has that name.
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

    def __repr__(self) -> str:
        return f"Sent({len(self._rows)} rows: {', '.join(self.keys()) or 'nothing'})"

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __contains__(self, name: object) -> bool:
        return name in self.keys()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)  # `copy` asks objects without attributes.
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __getitem__(self, name: str) -> Any:
        found: list[Any] = []
        examples: list[Any] = []
        places: list[NDArray[np.intp]] = []
        lacking: list[NDArray[np.intp]] = []
        for columns, where in self._groups():
            unasked = self._rows[where[0]] == UNASKED
            if columns is not None and name in columns and unasked:
                examples.append(columns[name])
            if columns is None or name not in columns or unasked:
                lacking.append(where)
                continue
            found.append(mapped(lambda leaf, w=where: _rows_of(leaf, self._rows[w]), columns[name]))
            places.append(where)
        like = found or examples
        if not like and (self._rows == UNASKED).all():
            like = [np.empty(0)]
        if not like:
            known = ", ".join(self.keys()) or "nothing"
            raise KeyError(f"no {name!r} was sent for these results; sent were: {known}")
        if len(like) > 1 and len(set(map(form_of, like))) > 1:
            return self._listed(found, places)
        if lacking:
            missing = np.concatenate(lacking)
            example = like[0] if len(like) == 1 else concatenated(like)
            found.append(mapped(lambda leaf: _filler(leaf, len(missing)), example))
            places.append(missing)
        if len(found) < 2:
            return found[0] if found else like[0]
        return concatenated(found, np.argsort(np.concatenate(places)))

    def _listed(self, found: list[Any], places: list[NDArray[np.intp]]) -> list[Any]:
        """The values of columns with different forms; None for all other rows."""
        values: list[Any] = [None] * len(self._rows)
        for column, where in zip(found, places, strict=True):
            for row, place in enumerate(where.tolist()):
                values[place] = index(column, row)
        return values

    def _groups(self) -> Iterator[tuple[Mapping[str, Any] | None, NDArray[np.intp]]]:
        """Columns of requests, each with the rows of the batch that answer it."""
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
    """Make `count` placeholder rows with the shape and dtype of `leaf`."""
    if isinstance(leaf, list):
        return [None] * count
    if isinstance(leaf, np.ndarray):
        array = cast("NDArray[Any]", leaf)
        filler = np.zeros((count, *array.shape[1:]), array.dtype)
        if array.dtype.kind in "fcO":
            filler[...] = None if array.dtype.kind == "O" else np.nan
        return filler
    nothing = float("nan") if leaf.is_floating_point() else 0
    return leaf.new_full((count, *leaf.shape[1:]), nothing)


def columns_of_values(
    values: Sequence[PolicyResponse], *, actions_as_list: bool = False
) -> dict[str, Any]:
    """Stack single responses to columns; actions without fixed size stay a list."""
    extras = (getattr(value, "extras", {}) for value in values)
    names = dict.fromkeys(("action", *(name for own in extras for name in own)))
    rows = {name: [getattr(value, name, None) for value in values] for name in names}
    return {
        name: column if actions_as_list and name == "action" else columns_where_possible(column)
        for name, column in rows.items()
    }
