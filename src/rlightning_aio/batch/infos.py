"""Infos as columns, in the form of Gymnasium's vector environments.

Infos in slab rows are read column by column, others row by row. Unlike Gymnasium's, columns do not
depend on the order of the rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.protocol.info import has_mask, is_mask

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.protocol.info import InfoSchema


def vector_infos(infos: Sequence[Mapping[Any, Any]]) -> dict[Any, Any]:
    """Convert `infos` to columns: a typed array for each key, and a mask ``_key``.

    Infos of vector environments already have masks, which become columns of masks.
    """
    return columns_of_infos(dict(enumerate(infos)), len(infos))


def columns_of_infos(infos: Mapping[int, Mapping[Any, Any]], size: int) -> dict[Any, Any]:
    """Make columns of `size` rows from the infos of some rows, in any order.

    The dtype of a column holds all of its values, or is object. The mask of a key takes precedence
    over a key with the name of the mask.
    """
    values: dict[Any, dict[int, Any]] = {}
    masks: dict[str, dict[int, NDArray[np.bool_]]] = {}
    for row, info in infos.items():
        for key, value in info.items():
            found: dict[Any, dict[int, Any]] = masks if is_mask(key, info) else values
            found.setdefault(key, {})[row] = value
    names_of_masks = {f"_{key}" for key in values}
    columns: dict[Any, Any] = {}
    for key, own in values.items():
        if key not in names_of_masks:
            columns[key] = _column(key, own, size)
        columns.setdefault(f"_{key}", np.zeros(size, np.bool_))[list(own)] = True
    for key, own_masks in masks.items():
        shape = next(iter(own_masks.values())).shape
        columns[key] = np.broadcast_to(columns[key][:, None], (size, *shape)).copy()
        for row, mask in own_masks.items():
            columns[key][row] = mask
    return columns


def _column(key: Any, values: Mapping[int, Any], size: int) -> Any:
    """Column of a key: an array of `size` rows, or columns of dicts."""
    if key == "final_obs":  # Observations, dicts or not.
        return _filled(values, size, *_NOT_TYPED)
    if all(isinstance(value, dict) for value in values.values()):
        return columns_of_infos(values, size)
    dtype, shape = _type_of_all(list(values.values()))
    try:
        return _filled(values, size, dtype, shape)
    except OverflowError:  # An int of more than 64 bits.
        return _filled(values, size, *_NOT_TYPED)


def _filled(
    values: Mapping[int, Any], size: int, dtype: np.dtype[Any] | None, shape: tuple[int, ...]
) -> NDArray[Any]:
    column: NDArray[Any]
    column = np.full(size, None, object) if dtype is None else np.zeros((size, *shape), dtype)
    for row, value in values.items():
        column[row] = value
    return column


_NOT_TYPED: Final[tuple[None, tuple[int, ...]]] = None, ()
"""Dtype and shape of a column of objects."""


def _type_of_all(values: Sequence[Any]) -> tuple[np.dtype[Any] | None, tuple[int, ...]]:
    """Dtype that holds all of `values`, and their shape; None for a column of objects.

    As in Gymnasium, numbers are those of Python and NumPy, without `numpy.bool_`.
    """
    is_array = type(values[0]) is np.ndarray
    shape: tuple[int, ...] = values[0].shape if is_array else ()
    dtypes: set[np.dtype[Any]] = set()
    for value in values:
        kind = cast("Any", type(value))
        if (kind is np.ndarray) != is_array or getattr(value, "shape", ()) != shape:
            return _NOT_TYPED
        if not (is_array or kind in (int, float, bool) or np.number in kind.__mro__):
            return _NOT_TYPED
        dtypes.add(np.dtype(value.dtype if is_array else kind))
    if len(dtypes) > 1 and not all(dtype.kind in "biufc" for dtype in dtypes):
        return _NOT_TYPED
    dtype = np.result_type(*dtypes)
    if len(dtypes) > 1 and dtype.kind in "fc" and any(map(_is_large_int, values)):
        return _NOT_TYPED
    return dtype, shape


def _is_large_int(value: Any) -> bool:
    """Return True for ints, or an array of ints, that a float may not represent exactly."""
    is_int = np.asarray(value).dtype.kind in "iuO"
    return is_int and bool(np.any((value > 2**53) | (value < -(2**53))))


def infos_of_rows(part: ResultColumns, *, episodes: bool) -> dict[str, Any]:
    """Convert the infos of `part` to columns, in its order.

    Args:
        part: results.
        episodes: add ``episode``, the sums of episodes that have just ended.
    """
    if part.info_marks is None and not part.out_of_band and not episodes:
        return {}
    rows = range(len(part))
    columns = None if part.out_of_band else _columns_of_rows(part)
    if columns is None:
        info_of = part.info_of if episodes else part.reported_info_of
        return vector_infos([info_of(row) for row in rows])
    if episodes and part.episode_length is not None:
        if "episode" in columns:  # The env's own value takes precedence.
            return vector_infos([part.info_of(row) for row in rows])
        sums = {row: {"episode": sums} for row in rows if (sums := part.episode(row))}
        columns = {**columns_of_infos(sums, len(part)), **columns}
    return columns


def info_list_of_rows(part: ResultColumns) -> list[dict[str, Any]]:
    """List the reported infos of `part`, in its order."""
    if part.out_of_band:
        return [part.reported_info_of(row) for row in range(len(part))]
    infos: list[dict[str, Any]] = [{} for _ in range(len(part))]
    for schema, chosen in _rows_by_schema(part).items():
        assert part.info is not None, "schemas come with infos in rows"
        for row, info in zip(chosen, schema.decode_all(part.info[chosen]), strict=True):
            infos[row] = info
    return infos


def infos_of_each(info: dict[str, Any], num_envs: int) -> dict[str, Any]:
    """Columns with masks of the info of a vector environment with `num_envs` envs.

    A value of the whole environment is repeated for each env.
    """
    if _is_of_each(info, num_envs):
        return info
    columns: dict[str, Any] = {
        key: infos_of_each(cast("dict[str, Any]", value), num_envs)
        if isinstance(value, dict)
        else _of_each(value, num_envs)
        for key, value in info.items()
    }
    for key in [key for key in columns if not has_mask(key, columns)]:
        columns[f"_{key}"] = np.ones(num_envs, np.bool_)
    return columns


def _is_of_each(info: dict[Any, Any], num_envs: int) -> bool:
    """Return True if all values are arrays with a row for each sub-environment, and have masks."""
    for key, value in info.items():
        if type(value) is not np.ndarray or not value.ndim or len(value) != num_envs:
            return False
        if type(key) is not str or not (key[:1] == "_" or f"_{key}" in info):
            return False
    return True


def _of_each(value: Any, num_envs: int) -> NDArray[Any]:
    """Values of the sub-environments; a single value is repeated for each."""
    if getattr(value, "shape", ())[:1] == (num_envs,):
        return value
    if isinstance(value, np.ndarray):
        return np.stack([cast("NDArray[Any]", value)] * num_envs)
    if isinstance(value, int | float | np.generic):
        return np.full(num_envs, value)
    each = cast("Sequence[Any]", value)
    if not isinstance(value, list | tuple) or len(each) != num_envs:
        each = [cast("Any", value)] * num_envs
    return _filled(dict(enumerate(each)), num_envs, *_NOT_TYPED)


def listed(columns: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Split columns with masks into one info for each of `count` envs.

    Numbers are NumPy's, bools are Python's.
    """
    names = [name for name in columns if not is_mask(name, columns)]
    masks = [columns[f"_{name}"] for name in names]
    values = [_values_of_each(columns[name], count) for name in names]
    if all(mask.all() for mask in masks):
        if not names:
            return [{} for _ in range(count)]
        return [dict(zip(names, own, strict=True)) for own in zip(*values, strict=True)]
    infos: list[dict[str, Any]] = [{} for _ in range(count)]
    for name, mask, each in zip(names, masks, values, strict=True):
        for k in np.flatnonzero(mask).tolist():
            infos[k][name] = each[k]
    return infos


def _values_of_each(column: Any, count: int) -> list[Any]:
    if isinstance(column, dict):
        return listed(cast("dict[str, Any]", column), count)
    # NumPy's bools would become objects in a column.
    return column.tolist() if column.dtype == np.bool_ and column.ndim == 1 else list(column)


def _columns_of_rows(part: ResultColumns) -> dict[str, Any] | None:
    """Read infos in rows column by column; None if they must be read one by one."""
    schema = _schema_of_all(part)
    if schema is not None:
        return {key: values.copy() for key, values in _fields(part, schema).items()}
    rows = _rows_by_schema(part)
    return _of_some(part.info, rows) if _agree(rows) else None


def _schema_of_all(part: ResultColumns) -> InfoSchema | None:
    """The schema of all rows, if they share one with typed columns."""
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
    """Views of columns present in all rows, each with its mask."""
    fields = schema.fields(cast("NDArray[np.uint8]", part.info))
    for key in schema.without_mask:
        fields[f"_{key}"] = np.ones(len(part), np.bool_)
    return fields


def _rows_by_schema(part: ResultColumns) -> dict[InfoSchema, list[int]]:
    """Rows grouped by the schema of their info."""
    rows: dict[InfoSchema, list[int]] = {}
    if part.info is None or part.info_marks is None:
        return rows
    # A worker has one object for each schema, so group by identity before comparing.
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


def _agree(schemas: Collection[InfoSchema]) -> bool:
    """Return True if each key has one typed column in all of `schemas`."""
    kinds: dict[str, tuple[Any, ...]] = {}
    for schema in schemas:
        for key, kind, array in zip(schema.keys, schema.types, schema.arrays, strict=True):
            # Only some may have a reported mask.
            known = kind, array, f"_{key}" in schema.masks
            if kinds.setdefault(key, known) != known:
                return False
        if not schema.is_typed:
            return False
    # A key with the name of another key's mask must be read row by row.
    masks = {f"_{key}" for key in kinds}
    return not any(masks & schema.keys_but_masks for schema in schemas)


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
