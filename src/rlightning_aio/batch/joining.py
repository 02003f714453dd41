"""Joins batches of results, for callers that keep results while they wait for others."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from msgspec.structs import replace

from rlightning_aio.batch.columns import BY_ROW
from rlightning_aio.batch.data import (
    BatchedData,
    Origin,
    batch_of_results,
    origin_of,
    parts_of,
    sources_of,
    with_repeats,
)
from rlightning_aio.batch.sent import joined_sources
from rlightning_aio.batch.stacking import concatenated
from rlightning_aio.trees import key_of, walked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns


def joined(batches: Sequence[BatchedData]) -> BatchedData:
    """Concatenate the results of several batches of one group.

    Envs with the same layout share columns, which are new. `BatchedData.take` reorders rows.

    Raises:
        ValueError: there is no batch, or a batch doesn't hold results of the same group.
    """
    if not batches:
        raise ValueError("there is no batch to join")
    if len(batches) == 1:
        return batches[0]
    origins = [origin_of(batch) for batch in batches]
    last = origins[-1]
    if last is None or any(o is None or o.issuer is not last.issuer for o in origins):
        raise ValueError("only batches of results of one group can be joined")
    slots = np.concatenate([cast("Origin", origin).slots for origin in origins])
    placed = [part for k, batch in enumerate(batches) for part in _placed(batch, batches[:k])]
    parts = _merged(placed)
    if len(parts) == 1:
        parts = [replace(parts[0], positions=None)]
    sources = joined_sources([(sources_of(batch), len(batch)) for batch in batches])
    return with_repeats(batch_of_results(parts, last.issuer, slots, last.names, sources))


def _placed(batch: BatchedData, before: Sequence[BatchedData]) -> list[ResultColumns]:
    """Parts of `batch`, with positions that follow those of the batches `before`."""
    offset = sum(map(len, before))
    return [
        replace(
            part,
            positions=(np.arange(len(part)) if part.positions is None else part.positions) + offset,
        )
        for part in parts_of(batch)
    ]


def _merged(parts: list[ResultColumns]) -> list[ResultColumns]:
    """Merge parts with the same row layout."""
    alike: dict[Any, list[ResultColumns]] = {}
    for k, part in enumerate(parts):
        alike.setdefault(_layout(part) or k, []).append(part)
    return [group[0] if len(group) == 1 else _one(group) for group in alike.values()]


def _layout(part: ResultColumns) -> Any:
    """Key that is equal for parts that can be merged; None for a part that can't be.

    The schemas are part of it, because a replaced worker's rows need the schemas of that worker.
    """
    forms = [(path, _form(array)) for path, array in walked(part.observation)]
    if any(form is None for _, form in forms):
        return None
    return (
        key_of(part.observation, _form),
        part.reward.shape[1:],
        part.agents,
        None if part.info is None else (part.info.shape[1:], id(part.schemas)),
        part.sent_ns is None,
    )


def _form(array: Any) -> Any:
    """The shape and dtype of rows; None for values that aren't in an array."""
    return (array.shape[1:], array.dtype) if type(array) is np.ndarray else None


def _one(parts: list[ResultColumns]) -> ResultColumns:
    """Concatenate parts with the same layout, with rows in the order of their positions."""
    positions = np.concatenate([cast("NDArray[np.intp]", part.positions) for part in parts])
    order = np.argsort(positions)
    count = len(positions)

    def joined_rows(name: str) -> Any:
        columns: list[Any] = [getattr(part, name) for part in parts]
        if all(column is None for column in columns):
            return None
        known = next(column for column in columns if column is not None)
        filled = [
            np.zeros((len(part), *known.shape[1:]), known.dtype) if column is None else column
            for part, column in zip(parts, columns, strict=True)
        ]
        return np.concatenate(filled)[order]

    first_rows = np.cumsum([0, *map(len, parts)]).tolist()
    place = np.empty(count, np.intp)
    place[order] = np.arange(count)
    return replace(
        parts[0],
        names=parts[-1].names,
        positions=positions[order],
        observation=concatenated([part.observation for part in parts], order),
        out_of_band={
            int(place[first + row]): kept
            for first, part in zip(first_rows, parts, strict=False)
            for row, kept in part.out_of_band.items()
        },
        **{name: joined_rows(name) for name in ("slots", *BY_ROW)},
    )
