"""Infos as columns, in the form of Gymnasium's vector environments.

Where envs put theirs into their rows, whole columns are taken out at once; Gymnasium's own code,
which goes env by env and key by key, says what they mean and does the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from gymnasium.vector import VectorEnv

from rlightning_aio.protocol.info import has_mask, is_mask

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.protocol.info import InfoSchema

__all__ = [
    "info_list_of_rows",
    "infos_of_rows",
    "listed",
    "sub_env_infos_of_rows",
    "vector_infos",
]


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


def sub_env_infos_of_rows(part: ResultColumns, num_envs: int) -> dict[str, Any]:
    """Infos of rows with sub-environments as those of one row of envs: ``[n * num_envs, ...]``.

    What an env tells of all its sub-environments is each one's.
    """
    columns = None
    if not part.out_of_band:
        schema = _schema_of_all(part)
        # Uncopied: to flatten a column of several rows is to copy it.
        columns = _taken_at_once(part) if schema is None else _fields(part, schema)
    if columns is None:
        return _joined([part.reported_info_of(row) for row in range(len(part))], num_envs)
    flat: dict[str, Any] = {}
    for key, column in columns.items():
        if column.shape[1:2] == (num_envs,):
            flat[key] = column.reshape(-1, *column.shape[2:])
        else:
            flat[key] = column.repeat(num_envs, axis=0)
    return flat


def _joined(infos: Sequence[dict[str, Any]], num_envs: int) -> dict[str, Any]:
    """Infos of vector environments of `num_envs` each, one after the other."""
    total = len(infos) * num_envs
    joined: dict[str, Any] = {}
    for key in dict.fromkeys(key for info in infos for key in info):
        told = [info.get(key) for info in infos]
        if any(isinstance(value, dict) for value in told):
            joined[key] = _joined([value or {} for value in told], num_envs)
            continue
        for k, value in enumerate(told):
            if value is None:
                continue
            is_column = getattr(value, "shape", ())[:1] == (num_envs,)
            values: Any = value if is_column else _repeated(value, num_envs)
            if key not in joined:
                joined[key] = np.zeros((total, *values.shape[1:]), values.dtype)
                if values.dtype == object:
                    joined[key][:] = None
            joined[key][k * num_envs : (k + 1) * num_envs] = values
    for key in [key for key in joined if not has_mask(key, joined)]:
        mask = np.array([key in info for info in infos])
        joined[f"_{key}"] = mask.repeat(num_envs)
    return joined


def _repeated(value: Any, num_envs: int) -> Any:
    if isinstance(value, np.ndarray):
        return np.stack([cast("NDArray[Any]", value)] * num_envs)
    is_number = isinstance(value, int | float | np.generic)
    return np.full(num_envs, value, None if is_number else object)


def listed(columns: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Columns with masks as one info for each of `count` envs; numbers are NumPy's."""
    names = [name for name in columns if not is_mask(name, columns)]
    masks = [columns[f"_{name}"] for name in names]
    values = [
        listed(cast("dict[str, Any]", column), count) if isinstance(column, dict) else list(column)
        for column in (columns[name] for name in names)
    ]
    if all(mask.all() for mask in masks):
        if not names:
            return [{} for _ in range(count)]
        return [dict(zip(names, own, strict=True)) for own in zip(*values, strict=True)]
    infos: list[dict[str, Any]] = [{} for _ in range(count)]
    for name, mask, each in zip(names, masks, values, strict=True):
        for k in np.flatnonzero(mask).tolist():
            infos[k][name] = each[k]
    return infos


def _taken_at_once(part: ResultColumns) -> dict[str, Any] | None:
    """Columns of infos that all lie in the rows; None where they need to be looked at singly."""
    schema = _schema_of_all(part)
    if schema is not None:
        return {key: values.copy() for key, values in _fields(part, schema).items()}
    rows = _rows_by_schema(part)
    return _of_some(part.info, rows) if _agree(rows) else None


def _schema_of_all(part: ResultColumns) -> InfoSchema | None:
    """The one shape that the infos of all rows have, if they become typed columns."""
    if part.info is None or part.info_marks is None:
        return None
    found: InfoSchema | None = None
    slots: list[int] = part.slots.tolist()
    marks: list[int] = part.info_marks.tolist()
    for slot, mark in zip(slots, marks, strict=True):
        schema = part.schemas[slot].get(mark)
        if schema is None or (found is not None and found is not schema and found != schema):
            return None
        found = schema
    return found if found is not None and found.is_typed else None


def _fields(part: ResultColumns, schema: InfoSchema) -> dict[str, Any]:
    """Views of columns that all rows have, each with its mask."""
    fields = schema.fields(cast("NDArray[np.uint8]", part.info))
    for key in schema.without_mask:
        fields[f"_{key}"] = np.ones(len(part), np.bool_)
    return fields


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
            if kinds.setdefault(key, known) != known:
                return False
        if not schema.is_typed:
            return False
    return True


def _of_some(info: Any, rows: dict[InfoSchema, list[int]]) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for schema, chosen in rows.items():
        fields = schema.fields(info[chosen])
        for key, values in fields.items():
            masked = has_mask(key, fields)
            if key not in columns:
                columns[key] = np.zeros((len(info), *values.shape[1:]), values.dtype)
                if not masked:
                    columns[f"_{key}"] = np.zeros(len(info), np.bool_)
            columns[key][chosen] = values
            if not masked:
                columns[f"_{key}"][chosen] = True
    return columns
