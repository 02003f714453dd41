"""`Codec`: msgpack with arrays as maps, as both protocols have them.

An array is a map of ``__ndarray__``, ``data``, ``dtype`` and ``shape``; openpi writes these keys as
bytes, vla-eval as text. Only arrays of numbers and bools exist.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import numpy as np

from rlightning_aio.trees import as_array

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Codec"]

_NUMBERS: Final = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")
"""The dtypes of arrays that may arrive."""


class Codec:
    """Encodes and decodes frames.

    Args:
        key: converts the name of a field to a key of the map of an array.
    """

    def __init__(self, key: Callable[[str], str | bytes]) -> None:
        self._array, self._scalar, self._data, self._dtype, self._shape = map(
            key, ("__ndarray__", "__npgeneric__", "data", "dtype", "shape")
        )

    def encode(self, value: Any) -> bytes:
        """Return a frame.

        Raises:
            TypeError: `value` has something other than arrays, numbers, texts, lists and maps.
            RecursionError: it contains itself.
        """
        return msgspec.msgpack.encode(value, enc_hook=self._written)

    def _written(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            return cast("Any", value).item()
        if not isinstance(value, np.ndarray) and not hasattr(value, "detach"):
            raise TypeError(f"a {type(value).__name__} can't be sent to a policy server")
        array = as_array(value)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"an array of {array.dtype} can't be sent to a policy server")
        return {
            self._array: True,
            self._data: array.tobytes(),
            self._dtype: array.dtype.str,
            self._shape: array.shape,
        }

    def decode(self, frame: bytes) -> Any:
        """Return what a frame holds, with arrays.

        Raises:
            ValueError: it can't be decoded, or an array in it is none of numbers.
        """
        try:
            return self._read(msgspec.msgpack.decode(frame))
        except (msgspec.DecodeError, RecursionError, TypeError, KeyError) as error:
            raise ValueError(str(error)) from error

    def _read(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._read(inner) for inner in cast("list[Any]", value)]
        if not isinstance(value, dict):
            return value
        fields = cast("dict[Any, Any]", value)
        if self._array in fields:
            dtype, shape = self._dtype_of(fields), fields[self._shape]
            return np.frombuffer(fields[self._data], dtype).reshape(shape)
        if self._scalar in fields:
            return self._dtype_of(fields).type(fields[self._data])
        return {key: self._read(inner) for key, inner in fields.items()}

    def _dtype_of(self, fields: dict[Any, Any]) -> np.dtype[Any]:
        name = fields[self._dtype]
        if not isinstance(name, str) or not _NUMBERS.fullmatch(name):
            raise ValueError(f"an array has dtype {name!r}, which is none of numbers")
        return np.dtype(name)
