"""Infos as columns, in the form of Gymnasium's vector environments.

Where envs put theirs into their rows, whole columns are taken out at once; Gymnasium's own code,
which goes env by env and key by key, says what they mean and does the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Sequence

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.protocol.info import InfoSchema

__all__ = ["info_list_of_rows", "infos_of_rows", "vector_infos"]

_AS_OBJECTS = np.bool_
"""A kind of number of which Gymnasium makes no typed array."""


class _Columns(VectorEnv[Any, Any, Any]):
    """Knows how infos become columns, and nothing else of an environment."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs

    def of(self, infos: Iterable[tuple[int, dict[str, Any]]]) -> dict[str, Any]:
        columns: dict[str, Any] = {}
        for place, info in infos:
            columns = self._add_info(columns, info, place)
        return columns

    def _add_info(
        self, vector_infos: dict[str, Any], env_info: dict[str, Any], env_num: int
    ) -> dict[str, Any]:
        masks = {key: value for key, value in env_info.items() if is_mask(key, env_info)}
        if not masks:
            return super()._add_info(vector_infos, env_info, env_num)
        rest = {key: value for key, value in env_info.items() if key not in masks}
        columns = super()._add_info(vector_infos, rest, env_num)
        for key, mask in masks.items():
            if columns[key].ndim == 1:
                outer = columns[key][:, None]
                columns[key] = np.broadcast_to(outer, (self.num_envs, *mask.shape)).copy()
            columns[key][env_num] = mask
        return columns


def is_mask(key: str, info: Container[str]) -> bool:
    """Whether a vector environment tells by `key` which sub-environments have another one."""
    return key.startswith("_") and key[1:] in info


def _has_mask(key: str, info: Container[str]) -> bool:
    """Whether `key` needs none made: it has one among the infos, or is one."""
    return f"_{key}" in info or is_mask(key, info)


def vector_infos(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One dict of columns for `infos`: a typed array for each key, and a mask ``_key``.

    Those of vector environments have masks already, which become columns of masks.
    """
    return _Columns(len(infos)).of(enumerate(infos))


def infos_of_rows(part: ResultColumns, *, episodes: bool) -> dict[str, Any]:
    """The same for the rows of `part`, in its own order.

    Args:
        part: results.
        episodes: with ``episode``, the sums of each that has just ended.
    """
    rows = range(len(part))
    columns = None if part.out_of_band else _taken_at_once(part)
    if columns is None:
        told = part.info_of if episodes else part.reported_info_of
        return vector_infos([told(row) for row in rows])
    if episodes and part.episode_length is not None:
        if "episode" in columns:  # What an env reports under that key goes before.
            return vector_infos([part.info_of(row) for row in rows])
        sums = [(row, {"episode": sums}) for row in rows if (sums := part.episode(row))]
        columns = {**_Columns(len(part)).of(sums), **columns}
    return columns


def info_list_of_rows(part: ResultColumns) -> list[dict[str, Any]]:
    """One info for each row of `part`, as the envs told them, in its own order."""
    if part.out_of_band:
        return [part.reported_info_of(row) for row in range(len(part))]
    infos: list[dict[str, Any]] = [{} for _ in range(len(part))]
    for schema, chosen in _rows_by_schema(part).items():
        assert part.info is not None, "there are rows that hold some"
        for row, info in zip(chosen, schema.decode_all(part.info[chosen]), strict=True):
            infos[row] = info
    return infos


def _taken_at_once(part: ResultColumns) -> dict[str, Any] | None:
    """Columns of infos that all lie in the rows; None where they need to be looked at singly."""
    rows = _rows_by_schema(part)
    if len(rows) == 1 and part.info is not None:
        ((schema, chosen),) = rows.items()
        if len(chosen) == len(part) and _agree(rows):
            return _of_all(schema.fields(part.info))
    return _of_some(part.info, rows) if _agree(rows) else None


def _rows_by_schema(part: ResultColumns) -> dict[InfoSchema, list[int]]:
    """Which rows hold infos of one shape."""
    rows: dict[InfoSchema, list[int]] = {}
    if part.info is None or part.info_marks is None:
        return rows
    # A worker's schema is one object: few need to be compared.
    rows_of: dict[int, list[int]] = {}
    slots: list[int] = part.slots.tolist()
    marks: list[int] = part.info_marks.tolist()
    for row, (slot, mark) in enumerate(zip(slots, marks, strict=True)):
        if not mark:
            continue
        schema = part.schemas[slot][mark]
        chosen = rows_of.get(id(schema))
        if chosen is None:
            chosen = rows_of[id(schema)] = rows.setdefault(schema, [])
        chosen.append(row)
    return rows


def _agree(schemas: Iterable[InfoSchema]) -> bool:
    """Whether each key has one typed column in all of `schemas`."""
    kinds: dict[str, tuple[Any, ...]] = {}
    for schema in schemas:
        for key, kind, array in zip(schema.keys, schema.types, schema.arrays, strict=True):
            # Some may have a mask of their own, others not.
            known = kind, array, f"_{key}" in schema.keys
            if kinds.setdefault(key, known) != known or kind is _AS_OBJECTS:
                return False
            if key == "final_obs" or (array is not None and 0 in array[0]):
                return False
    return True


def _of_all(fields: dict[str, Any]) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for key, values in fields.items():
        columns[key] = values.copy()
        if not _has_mask(key, fields):
            columns[f"_{key}"] = np.ones(len(values), np.bool_)
    return columns


def _of_some(info: Any, rows: dict[InfoSchema, list[int]]) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for schema, chosen in rows.items():
        fields = schema.fields(info[chosen])
        for key, values in fields.items():
            has_mask = _has_mask(key, fields)
            if key not in columns:
                columns[key] = np.zeros((len(info), *values.shape[1:]), values.dtype)
                if not has_mask:
                    columns[f"_{key}"] = np.zeros(len(info), np.bool_)
            columns[key][chosen] = values
            if not has_mask:
                columns[f"_{key}"][chosen] = True
    return columns
