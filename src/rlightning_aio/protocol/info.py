"""Small info dicts in shared memory: written without pickling, decoded only when read.

Most envs report the same few numbers under the same keys at every step. The worker
announces such a shape once, as a schema, and from then on packs only the values into
the row. An info that fits no schema (nested, strings, too large) travels pickled.
Types survive: a NumPy scalar comes back as the NumPy scalar it was.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Container

    from numpy.typing import NDArray

__all__ = [
    "INFO_BYTES",
    "INFO_BYTES_OF_SUB_ENV",
    "NO_INFO",
    "PICKLED",
    "InfoSchema",
    "InfoWriter",
    "has_mask",
    "is_mask",
]

INFO_BYTES: Final = 512
"""Of a row; with sub-environments at least."""
INFO_BYTES_OF_SUB_ENV: Final = 128
NO_INFO: Final = 0
PICKLED: Final = 255
"""Row marks: 0 no info, 1 to 254 the number of a schema, 255 the info is out of band."""

_AS_OBJECTS: Final = np.bool_
"""A kind of number of which Gymnasium makes no typed array."""
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


def is_mask(key: str, info: Container[str]) -> bool:
    """Whether a vector environment tells by `key` which sub-environments have another one."""
    return key.startswith("_") and key[1:] in info


def has_mask(key: str, info: Container[str]) -> bool:
    """Whether `key` needs none made: it has one among the infos, or is one."""
    return f"_{key}" in info or is_mask(key, info)


@dataclass(frozen=True)
class InfoSchema:
    """How a row holds infos of one shape.

    Attributes:
        keys: the dict's keys, in order.
        types: the exact type of each value.
        arrays: for each value shape and dtype if it is an array, else None.
        format: `struct` format of all values.
    """

    keys: tuple[str, ...]
    types: tuple[type, ...]
    arrays: tuple[tuple[tuple[int, ...], str] | None, ...]
    format: str

    @classmethod
    def of(cls, info: dict[str, Any]) -> InfoSchema | None:
        """The schema of `info`, or None if it can't travel in a row."""
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
        """Bytes of a row that it uses."""
        return struct.calcsize(self.format)

    @cached_property
    def _dtype(self) -> np.dtype[Any]:
        """The bytes of a row as a structured array knows them."""
        return np.dtype(
            [
                (key, _SCALARS[kind]) if array is None else (key, array[1], array[0])
                for key, kind, array in zip(self.keys, self.types, self.arrays, strict=True)
            ]
        )

    @cached_property
    def is_typed(self) -> bool:
        """Whether Gymnasium makes typed arrays of all values, one column for each key."""
        return (
            _AS_OBJECTS not in self.types
            and "final_obs" not in self.keys
            and not any(array is not None and 0 in array[0] for array in self.arrays)
        )

    @cached_property
    def without_mask(self) -> tuple[str, ...]:
        """Keys that are no mask, and have none among the others."""
        return tuple(key for key in self.keys if not has_mask(key, self.keys))

    def fields(self, rows: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """What ``rows [n, bytes]`` hold, one column for each key; views of a copy."""
        values = np.ascontiguousarray(rows[:, : self.size]).view(self._dtype)[:, 0]
        return {key: values[key] for key in self.keys}

    def decode(self, row: bytes | memoryview) -> dict[str, Any]:
        """The info that `row` holds; arrays are fresh and writable."""
        values = struct.unpack_from(self.format, row)
        return {
            key: _restored(value, value_type, array)
            for key, value, value_type, array in zip(
                self.keys, values, self.types, self.arrays, strict=True
            )
        }

    def decode_all(self, rows: NDArray[np.uint8]) -> list[dict[str, Any]]:
        """The infos that ``rows [n, bytes]`` hold."""
        if any(self.arrays):
            return [self.decode(memoryview(row)) for row in rows]
        # Elements of an array are NumPy's scalars, those of its list are Python's.
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
        row: the row's info bytes, writable.
        announce: tells the trainer of a new schema; returns its number, or `PICKLED` if
            the worker has announced too many.
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
        """Put `info` into the row; the mark that says how, `PICKLED` if it can't be."""
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
        except struct.error:  # An int beyond 64 bits.
            return PICKLED
        return self._number

    def read(self, mark: int) -> dict[str, Any]:
        """The info that was written last, with its mark; empty if it isn't in the row."""
        if mark in (NO_INFO, PICKLED) or self._schema is None:
            return {}
        return self._schema.decode(self._row)

    def _write_arrays(self, info: dict[str, Any]) -> int:
        values = list(info.values())
        for position, shape, dtype in self._arrays:
            array = values[position]
            if array.shape != shape or array.dtype != dtype:
                self._keys = []  # Another schema; take it up at the next write.
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
    """The schemas that one worker has announced, numbered from 1 (its own side of them)."""

    def __init__(self, send: Callable[[int, InfoSchema], None]) -> None:
        self._numbers: dict[InfoSchema, int] = {}
        self._send = send

    def announce(self, schema: InfoSchema) -> int:
        """The number of `schema`; sent to the trainer when it is new."""
        number = self._numbers.get(schema)
        if number is None:
            if len(self._numbers) >= _MAX_SCHEMAS:
                return PICKLED
            number = self._numbers[schema] = len(self._numbers) + 1
            self._send(number, schema)
        return number
