"""Small info dicts in shared memory: written without pickling, decoded only when read.

Most envs report a few numbers under the same keys in each step. The worker announces these keys and
types once, as a schema, and then packs only the values into the row. An info that fits no schema
(nested, strings, too large) is pickled. Types are preserved, also those of NumPy scalars.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

INFO_BYTES: Final = 512
"""Space for infos in a row; the minimum for rows with sub-environments."""
INFO_BYTES_OF_SUB_ENV: Final = 128
NO_INFO: Final = 0
PICKLED: Final = 255
"""Marks of rows: 0 without an info, 1 to 254 for a schema, 255 for an info out of band."""

_AS_OBJECTS: Final = np.bool_
"""Gymnasium stores numbers of this type in arrays of objects."""
_MAX_SCHEMAS: Final = 254

_SCALARS: Final[dict[type, str]] = {
    float: "d",
    np.float64: "d",
    np.float32: "f",
    int: "q",
    np.int64: "q",
    np.int32: "i",
    bool: "?",
    np.bool_: "?",
}


def is_mask(key: Any, info: Mapping[Any, Any]) -> bool:
    """Return True if the value of `key` is a mask: of sub-environments that have another key.

    A mask is an array of bools under the name of the other key, prefixed with an underscore.
    """
    if not isinstance(key, str) or not key.startswith("_") or key[1:] not in info:
        return False
    value: Any = info.get(key)
    return type(value) is np.ndarray and value.dtype == np.bool_ and value.ndim > 0


def has_mask(key: Any, info: Mapping[Any, Any]) -> bool:
    """Return True if `key` has a mask in `info`, or is one."""
    return is_mask(f"_{key}", info) or is_mask(key, info)


@dataclass(frozen=True)
class InfoSchema:
    """Keys and types of an info, and its layout in a row.

    Attributes:
        keys: of the dict, in order.
        types: the exact type of each value.
        arrays: shape and dtype of each value that is an array, else None.
        format: `struct` format of all values.
    """

    keys: tuple[str, ...]
    types: tuple[type, ...]
    arrays: tuple[tuple[tuple[int, ...], str] | None, ...]
    format: str

    @classmethod
    def of(cls, info: dict[str, Any]) -> InfoSchema | None:
        """Make the schema of `info`, or None if it can't be stored in a row."""
        arrays: list[tuple[tuple[int, ...], str] | None] = []
        codes = "="
        kinds = tuple(map(type, info.values()))
        for (key, value), kind in zip(info.items(), kinds, strict=True):
            if type(key) is not str:
                return None
            if (code := _SCALARS.get(kind)) is not None:
                arrays.append(None)
                codes += code
            elif kind is np.ndarray and not value.dtype.hasobject:
                arrays.append((value.shape, value.dtype.str))
                codes += f"{value.nbytes}s"
            else:
                return None
        return cls(tuple(info), kinds, tuple(arrays), codes)

    @cached_property
    def size(self) -> int:
        """Size in bytes in a row."""
        return struct.calcsize(self.format)

    @cached_property
    def _dtype(self) -> np.dtype[Any]:
        """The layout as the dtype of a structured array, whose fields can't have all names."""
        return np.dtype(
            [
                (str(k), _SCALARS[kind]) if array is None else (str(k), array[1], array[0])
                for k, (kind, array) in enumerate(zip(self.types, self.arrays, strict=True))
            ]
        )

    @cached_property
    def is_typed(self) -> bool:
        """True if Gymnasium makes one typed column for each key."""
        return (
            _AS_OBJECTS not in self.types
            and "final_obs" not in self.keys
            and not any(array is not None and 0 in array[0] for array in self.arrays)
            and self.keys_but_masks.isdisjoint(f"_{key}" for key in self.keys)
        )

    @cached_property
    def masks(self) -> frozenset[str]:
        """Keys that are masks of others; see `is_mask`."""
        # An info with these keys and types, without values.
        info = {
            key: None if array is None else np.empty(array[0], array[1])
            for key, array in zip(self.keys, self.arrays, strict=True)
        }
        return frozenset(key for key in self.keys if is_mask(key, info))

    @cached_property
    def keys_but_masks(self) -> frozenset[str]:
        """Keys that are not masks."""
        return frozenset(self.keys) - self.masks

    @cached_property
    def without_mask(self) -> tuple[str, ...]:
        """Keys that are not masks and have no mask."""
        masks = self.masks
        return tuple(key for key in self.keys if key not in masks and f"_{key}" not in masks)

    def fields(self, rows: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Decode ``rows [n, bytes]`` to one column for each key, which are views of a copy."""
        values = np.ascontiguousarray(rows[:, : self.size]).view(self._dtype)[:, 0]
        return {key: values[str(k)] for k, key in enumerate(self.keys)}

    def decode(self, row: bytes | memoryview) -> dict[str, Any]:
        """Decode the info in `row`; its arrays are new and writable."""
        values = struct.unpack_from(self.format, row)
        return {
            key: _restored(value, value_type, array)
            for key, value, value_type, array in zip(
                self.keys, values, self.types, self.arrays, strict=True
            )
        }

    def decode_all(self, rows: NDArray[np.uint8]) -> list[dict[str, Any]]:
        """Decode the infos in ``rows [n, bytes]``."""
        if any(self.arrays):
            return [self.decode(memoryview(row)) for row in rows]
        # `list` yields NumPy scalars, `tolist` those of Python.
        columns = [
            column.tolist() if kind in (float, int, bool) else list(column)
            for kind, column in zip(self.types, self.fields(rows).values(), strict=True)
        ]
        return [dict(zip(self.keys, values, strict=True)) for values in zip(*columns, strict=True)]


def _restored(value: Any, value_type: type, array: tuple[tuple[int, ...], str] | None) -> Any:
    if array is None:
        return value_type(value)
    shape, dtype = array
    return np.frombuffer(value, dtype).reshape(shape).copy()


class InfoWriter:
    """The worker's side for one env: packs infos into its row.

    Args:
        row: the writable info bytes of the row.
        announce: sends a new schema to the trainer; returns its number, or `PICKLED` if the worker
            has announced too many.
    """

    def __init__(self, row: memoryview, announce: Callable[[InfoSchema], int]) -> None:
        self._row = row
        self._announce = announce
        self._keys: list[str] = []
        self._types: list[type] = []
        self._arrays: list[tuple[int, tuple[int, ...], np.dtype[Any]]] = []
        self._number = PICKLED
        self._schema: InfoSchema | None = None
        self._pack: Callable[..., None] = struct.Struct("").pack_into

    def write(self, info: dict[str, Any]) -> int:
        """Write `info` to the row. Return its mark, `PICKLED` if it wasn't written."""
        if not info:
            return NO_INFO
        if [*info] != self._keys or [*map(type, info.values())] != self._types:
            self._adopt(info)
        if self._number == PICKLED:
            return PICKLED
        try:
            if self._arrays:
                return self._write_arrays(info)
            self._pack(self._row, 0, *info.values())
        except struct.error:  # An int of more than 64 bits.
            return PICKLED
        return self._number

    def read(self, mark: int) -> dict[str, Any]:
        """Decode the info that was written last, with its mark; empty if it isn't in the row."""
        if mark in (NO_INFO, PICKLED) or self._schema is None:
            return {}
        return self._schema.decode(self._row)

    def _write_arrays(self, info: dict[str, Any]) -> int:
        values = list(info.values())
        for position, shape, dtype in self._arrays:
            array = values[position]
            if array.shape != shape or array.dtype != dtype:
                self._keys = []  # The next write adopts the new schema.
                return PICKLED
            values[position] = array.tobytes()
        self._pack(self._row, 0, *values)
        return self._number

    def _adopt(self, info: dict[str, Any]) -> None:
        self._keys = [*info]
        self._types = [*map(type, info.values())]
        schema = InfoSchema.of(info)
        if schema is not None and schema.size > len(self._row):
            schema = None
        self._schema = schema
        self._number = PICKLED if schema is None else self._announce(schema)
        if schema is not None:
            self._pack = struct.Struct(schema.format).pack_into
            self._arrays = [
                (position, array[0], np.dtype(array[1]))
                for position, array in enumerate(schema.arrays)
                if array is not None
            ]


class InfoSchemas:
    """The worker's side: numbers its schemas from 1, and sends new ones."""

    def __init__(self, send: Callable[[int, InfoSchema], None]) -> None:
        self._numbers: dict[InfoSchema, int] = {}
        self._send = send

    def announce(self, schema: InfoSchema) -> int:
        """Return the number of `schema`; send it to the trainer if it is new."""
        number = self._numbers.get(schema)
        if number is None:
            if len(self._numbers) >= _MAX_SCHEMAS:
                return PICKLED
            number = self._numbers[schema] = len(self._numbers) + 1
            self._send(number, schema)
        return number
