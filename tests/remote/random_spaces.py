"""Random spaces and values, for properties that must hold for all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st

if TYPE_CHECKING:
    from collections.abc import Callable

_SHAPES = st.lists(st.integers(0, 4), max_size=3).map(tuple)
_FLOATS = st.sampled_from([np.float16, np.float32, np.float64])
_INTS = st.sampled_from([np.uint8, np.int8, np.int32, np.int64])


@st.composite
def _float_boxes(draw: st.DrawFn) -> spaces.Box:
    dtype, shape = draw(_FLOATS), draw(_SHAPES)
    bounds = st.sampled_from([0.5, 2.0, np.inf])
    high = np.full(shape, draw(bounds), dtype)
    if draw(st.booleans()) and high.size:
        high.flat[0] = draw(bounds)
    return spaces.Box(-high, high, dtype=dtype)


@st.composite
def _int_boxes(draw: st.DrawFn) -> spaces.Box:
    dtype = draw(_INTS)
    low = draw(st.integers(0, 3))
    return spaces.Box(low, low + draw(st.integers(1, 9)), draw(_SHAPES), dtype)


_KEYS = st.text("abcxyz ", max_size=4)
_LEAVES: st.SearchStrategy[gym.Space[Any]] = st.one_of(
    _float_boxes(),
    _int_boxes(),
    st.builds(spaces.Discrete, st.integers(1, 9), start=st.integers(-5, 5)),
    st.builds(spaces.MultiBinary, st.integers(1, 5)),
    st.builds(spaces.MultiBinary, st.lists(st.integers(1, 3), min_size=1, max_size=3)),
    st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 9), min_size=1, max_size=4)),
    st.builds(lambda n, m: spaces.Text(n + m, min_length=n), st.integers(0, 3), st.integers(1, 9)),
)


def _branches(inner: st.SearchStrategy[gym.Space[Any]]) -> st.SearchStrategy[gym.Space[Any]]:
    return st.one_of(
        st.lists(inner, max_size=3).map(spaces.Tuple),
        st.dictionaries(_KEYS, inner, max_size=3).map(spaces.Dict),
    )


any_space: st.SearchStrategy[gym.Space[Any]] = st.recursive(_LEAVES, _branches, max_leaves=6)


def sampled(space: gym.Space[Any], seed: int) -> Any:
    space.seed(seed)
    return space.sample()


def same(one: Any, other: Any) -> bool:
    """Return True if two values are equal in structure, dtype, shape and content."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, str):
        return one == other
    one, other = np.asarray(one), np.asarray(other)
    return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


_SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(allow_nan=False),
    st.text(max_size=8),
    st.binary(max_size=8),
)
_ARRAYS = st.builds(
    lambda shape, dtype, seed: np.random.default_rng(seed).integers(0, 2, shape).astype(dtype),
    _SHAPES,
    st.sampled_from([np.bool_, np.uint8, np.int64, np.float32, np.float64]),
    st.integers(0, 99),
)
any_info: st.SearchStrategy[dict[str, Any]] = st.dictionaries(
    st.text(max_size=5),
    st.recursive(
        _SCALARS | _ARRAYS,
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
        ),
        max_leaves=5,
    ),
    max_size=4,
)


def mutation(rng: np.random.Generator) -> Callable[[list[bytes]], list[bytes]]:
    """Return a random way to corrupt a message."""

    def flip(parts: list[bytes]) -> list[bytes]:
        k = int(rng.integers(len(parts)))
        spoilt = bytearray(parts[k] or b"\0")
        for _ in range(int(rng.integers(1, 5))):
            spoilt[int(rng.integers(len(spoilt)))] = int(rng.integers(256))
        return [*parts[:k], bytes(spoilt), *parts[k + 1 :]]

    def cut(parts: list[bytes]) -> list[bytes]:
        k = int(rng.integers(len(parts)))
        return [*parts[:k], parts[k][: int(rng.integers(len(parts[k]) + 1))], *parts[k + 1 :]]

    def lengthen(parts: list[bytes]) -> list[bytes]:
        k = int(rng.integers(len(parts)))
        return [*parts[:k], parts[k] + rng.bytes(int(rng.integers(1, 9))), *parts[k + 1 :]]

    def drop_part(parts: list[bytes]) -> list[bytes]:
        k = int(rng.integers(len(parts)))
        return [*parts[:k], *parts[k + 1 :]]

    def double_part(parts: list[bytes]) -> list[bytes]:
        k = int(rng.integers(len(parts)))
        return [*parts[: k + 1], *parts[k:]]

    def swap(parts: list[bytes]) -> list[bytes]:
        return [parts[k] for k in rng.permutation(len(parts))]

    def noise(parts: list[bytes]) -> list[bytes]:
        return [rng.bytes(int(rng.integers(0, 40))) for _ in range(int(rng.integers(0, 4)))]

    ways = [flip, flip, flip, cut, lengthen, drop_part, double_part, swap, noise]
    return ways[int(rng.integers(len(ways)))]
