"""Gymnasium spaces as plain data, in both directions: a client announces its spaces this way.

Rule: a description contains only dicts, lists, strings, numbers and booleans, so JSON and msgpack
can carry it and any language can write one. A space is built from it only after its size has been
checked. Deliberately left out: Sequence, Graph, OneOf and user-defined spaces, which have no fixed
form on the wire.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rlightning_aio.protocol.net.wire import DTYPES, MAX_FRAME_BYTES, WireError
from rlightning_aio.trees import converted, is_dict, is_tuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_MAX_DEPTH: Final = 16
_MAX_MEMBERS: Final = 256
_MAX_AXES: Final = 32
_MAX_TEXT: Final = 1 << 16
_SUPPORTED: Final = "Box, Discrete, MultiBinary, MultiDiscrete, Dict, Tuple and Text"

Description = dict[str, Any]


class UnsupportedSpace(ValueError):
    """An env client can't have such a space; the message has the position in the space."""


def describe(space: gym.Space[Any] | None, what: str) -> Description:
    """Return the description of `space`.

    Args:
        space: of an env.
        what: name of the space in messages.

    Raises:
        UnsupportedSpace: it is a space without a form on the wire, or contains one.
    """
    if is_dict(space):
        return _describe_dict(space, what)
    if is_tuple(space):
        parts = enumerate(space.spaces)
        return {"type": "tuple", "spaces": [describe(s, f"{what}[{k}]") for k, s in parts]}
    if isinstance(space, spaces.Text):
        return {
            "type": "text",
            "min_length": space.min_length,
            "max_length": space.max_length,
            "charset": "".join(sorted(space.character_set)),
        }
    if isinstance(space, spaces.Discrete):
        return {
            "type": "discrete",
            "n": int(space.n),
            "start": int(space.start),
            "dtype": _dtype_name(space, what),
        }
    if isinstance(space, spaces.MultiBinary):
        return {"type": "multi_binary", "n": np.asarray(space.n).tolist()}
    if isinstance(space, spaces.MultiDiscrete):
        return _describe_multi_discrete(cast("spaces.MultiDiscrete[Any]", space), what)
    if isinstance(space, spaces.Box):
        return _describe_box(cast("spaces.Box[Any]", space), what)
    raise UnsupportedSpace(
        f"{what} is {space!r}; an env client's spaces must be made of {_SUPPORTED}"
    )


def _describe_dict(space: spaces.Dict[Any], what: str) -> Description:
    # Pairs, because the order of a map's keys is lost in some languages.
    pairs: list[list[Any]] = []
    for key, inner in space.spaces.items():
        if not isinstance(key, str):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise UnsupportedSpace(f"{what} has the key {key!r}; keys must be strings")
        pairs.append([key, describe(inner, f"{what}[{key!r}]")])
    return {"type": "dict", "spaces": pairs}


def _describe_multi_discrete(space: spaces.MultiDiscrete[Any], what: str) -> Description:
    return {
        "type": "multi_discrete",
        "nvec": space.nvec.tolist(),
        "start": space.start.tolist(),
        "dtype": _dtype_name(space, what),
    }


def _describe_box(space: spaces.Box[Any], what: str) -> Description:
    return {
        "type": "box",
        "shape": list(space.shape),
        "dtype": _dtype_name(space, what),
        "low": _bounds(space.low),
        "high": _bounds(space.high),
    }


def _dtype_name(space: gym.Space[Any], what: str) -> str:
    name = np.dtype(space.dtype).name
    if name not in DTYPES:
        raise UnsupportedSpace(f"{what} has dtype {name}; it must be one of {', '.join(DTYPES)}")
    return name


def _bounds(array: NDArray[Any]) -> Any:
    """Return `array` as nested lists, without leading axes along which it is constant."""
    if not array.size:
        return 0
    # An axis with stride 0 repeats one value, so one element of it is enough.
    array = array[tuple(slice(0, 1 if stride == 0 else None) for stride in array.strides)]
    if (array == array.flat[0]).all():
        return _plain_number(array.flat[0].item())
    while array.ndim > 1 and (array == array[:1]).all():
        array = array[0]
    return converted(_plain_number, array.tolist())


def _plain_number(value: float) -> float | str:
    # JSON has no infinities.
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def space_from(description: Any) -> gym.Space[Any]:
    """Return the space that `description` describes.

    Raises:
        WireError: it is invalid, or an array exceeds `MAX_FRAME_BYTES`.
    """
    try:
        # Gymnasium's warnings do not matter here, even if the trainer turns them into errors.
        with (
            np.errstate(over="raise", invalid="raise", under="ignore", divide="ignore"),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            return _Builder().build(description)
    except WireError:
        raise
    # Gymnasium checks its arguments with assertions and by NumPy's errors.
    except (AssertionError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise WireError(f"a space description is not a valid space: {error}") from None


class _Builder:
    """Builds one space from an untrusted description, whose size is checked first."""

    def __init__(self) -> None:
        self._members_left = _MAX_MEMBERS
        self._levels_left = _MAX_DEPTH
        self._builders: dict[str, Callable[[Description], gym.Space[Any]]] = {
            "box": self._box,
            "discrete": self._discrete,
            "multi_binary": self._multi_binary,
            "multi_discrete": self._multi_discrete,
            "dict": self._dict,
            "tuple": self._tuple,
            "text": self._text,
        }

    def build(self, description: Any) -> gym.Space[Any]:
        """The space that `description` describes."""
        self._members_left -= 1
        if not (isinstance(description, dict) and self._levels_left and self._members_left >= 0):
            raise WireError(
                f"a space description is not a map, deeper than {_MAX_DEPTH} levels, or has more "
                f"than {_MAX_MEMBERS} members"
            )
        fields = cast("Description", description)
        build = self._builders.get(str(fields.get("type")))
        if build is None:
            raise WireError(f"a space description has the unknown type {fields.get('type')!r}")
        self._levels_left -= 1
        space = build(fields)
        self._levels_left += 1
        return space

    def _box(self, fields: Description) -> gym.Space[Any]:
        dtype = _dtype(fields)
        shape = self._shape(fields["shape"], dtype)
        low, high = (_bound_array(fields[bound], shape, dtype) for bound in ("low", "high"))
        return spaces.Box(low, high, dtype=dtype.type)

    def _discrete(self, fields: Description) -> gym.Space[Any]:
        n, start = _int(fields["n"]), _int(fields.get("start", 0))
        dtype = _dtype(fields, "int64")
        if dtype.kind not in "iu" or start + n > np.iinfo(dtype).max:
            raise WireError(f"a discrete space of {n} from {start} exceeds {dtype}")
        return spaces.Discrete(n, start=start, dtype=dtype.type)

    def _multi_binary(self, fields: Description) -> gym.Space[Any]:
        n = fields["n"]
        shape = self._shape(n if isinstance(n, list) else [n], np.dtype(np.int8))
        return spaces.MultiBinary(shape if isinstance(n, list) else shape[0])

    def _multi_discrete(self, fields: Description) -> gym.Space[Any]:
        dtype = _dtype(fields, "int64")
        nvec = np.array(_numbers(fields["nvec"], _MAX_AXES), dtype.type)
        self._shape(list(nvec.shape), dtype)
        start = np.array(_numbers(fields.get("start", 0), _MAX_AXES), dtype.type)
        space = spaces.MultiDiscrete(
            nvec, dtype=dtype.type, start=np.broadcast_to(start, nvec.shape).copy()
        )
        # All of it is above 0 by now, so this does not overflow itself.
        if (start > np.iinfo(dtype).max - nvec).any():
            raise WireError(f"a multi_discrete space exceeds {dtype}")
        return space

    def _dict(self, fields: Description) -> gym.Space[Any]:
        members: dict[str, gym.Space[Any]] = {}
        for key, inner in _list(fields["spaces"]):
            if not isinstance(key, str) or key in members:
                raise WireError(
                    f"a dict space has the key {key!r}, which is not a string or not new"
                )
            members[key] = self.build(inner)
        return spaces.Dict(list(members.items()), sort_keys=False)

    def _tuple(self, fields: Description) -> gym.Space[Any]:
        return spaces.Tuple([self.build(inner) for inner in _list(fields["spaces"])])

    def _text(self, fields: Description) -> gym.Space[Any]:
        longest, charset = _int(fields["max_length"]), fields["charset"]
        if longest > _MAX_TEXT or not isinstance(charset, str):
            raise WireError(f"a text space is longer than {_MAX_TEXT}, or has no charset")
        return spaces.Text(longest, min_length=_int(fields.get("min_length", 1)), charset=charset)

    def _shape(self, value: Any, dtype: np.dtype[Any]) -> tuple[int, ...]:
        shape = tuple(_int(extent) for extent in _list(value))
        if len(shape) > _MAX_AXES or min(shape, default=0) < 0:
            raise WireError(f"a space has a negative shape, or more than {_MAX_AXES} axes")
        if math.prod(shape) * dtype.itemsize > MAX_FRAME_BYTES:
            raise WireError(f"a space's array exceeds {MAX_FRAME_BYTES} bytes")
        return shape


def _dtype(fields: Description, default: str | None = None) -> np.dtype[Any]:
    name = fields.get("dtype", default)
    if not isinstance(name, str) or name not in DTYPES:
        raise WireError(f"a space has the dtype {name!r}; known are {', '.join(DTYPES)}")
    return DTYPES[name]


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise WireError(f"a space has {value!r} where a list belongs")
    return cast("list[Any]", value)


def _int(value: Any) -> int:
    if type(value) is not int:
        raise WireError(f"a space has {value!r} where a whole number belongs")
    return value


def _bound_array(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    # A copy: Gymnasium's own arrays can be written.
    return np.broadcast_to(np.array(_numbers(value, len(shape)), dtype.type), shape).copy()


def _numbers(value: Any, axes: int) -> Any:
    if isinstance(value, list) and axes:
        return [_numbers(inner, axes - 1) for inner in cast("list[Any]", value)]
    if value in ("inf", "-inf"):
        return float(value)
    if not isinstance(value, bool | int | float) or math.isnan(value):
        raise WireError(f"a space has {value!r} where a number belongs")
    return value
