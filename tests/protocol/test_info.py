"""Infos in rows are read as written, with their types."""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.protocol.info import (
    INFO_BYTES,
    NO_INFO,
    PICKLED,
    InfoSchema,
    InfoSchemas,
    InfoWriter,
)

FLOATS = st.floats(width=32)
SCALARS = st.one_of(
    st.floats(),
    st.integers(-(2**70), 2**70),
    st.booleans(),
    FLOATS.map(np.float32),
    st.floats().map(np.float64),
    st.integers(-(2**63), 2**63 - 1).map(np.int64),
    st.integers(-(2**31), 2**31 - 1).map(np.int32),
    st.booleans().map(np.bool_),
    st.integers(0, 255).map(np.uint8),
)
DTYPES = ("?", "u1", "<i4", ">i4", "<f2", "<f8", ">f8", "<U3", "<M8[s]", "S2", "i4,f8")
ARRAYS = st.builds(
    lambda dtype, shape, first: (
        (np.arange(first, first + prod(shape)) % 100)
        .astype(np.int64 if dtype != "?" else bool)
        .astype(np.dtype(dtype))
        .reshape(shape)
    ),
    st.sampled_from(DTYPES),
    st.sampled_from([(), (0,), (3,), (2, 2), (2, 0, 1)]),
    st.integers(0, 99),
)
UNFIT = st.one_of(st.text(max_size=3), st.none(), st.lists(st.integers(), max_size=2))
INFOS = st.dictionaries(st.sampled_from("abcd"), SCALARS | ARRAYS | UNFIT, max_size=4)


def same(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return (
            one.dtype == other.dtype
            and one.shape == other.shape
            and one.tobytes() == other.tobytes()
        )
    return one == other or one != one  # noqa: PLR0124  # Not a number.


class Row:
    """A writer, and a reader that knows only the announced schemas."""

    def __init__(self) -> None:
        self.announced: dict[int, InfoSchema] = {}
        self.memory = memoryview(bytearray(INFO_BYTES))
        self.schemas = InfoSchemas(self.announced.__setitem__)
        self.writer = InfoWriter(self.memory, self.schemas.announce)

    def through(self, info: dict[str, Any]) -> dict[str, Any] | None:
        """Write and read an info; None if it doesn't fit the row."""
        mark = self.writer.write(info)
        if mark == PICKLED:
            return None
        return {} if mark == NO_INFO else self.announced[mark].decode(self.memory)


@given(infos=st.lists(INFOS, max_size=8))
def test_infos_that_fit_a_row_are_read_unchanged(infos: list[dict[str, Any]]) -> None:
    """In sequence through one row, with any mixture of schemas: keys, order, types."""
    row = Row()
    for info in infos + infos:
        found = row.through(info)
        if found is not None:
            assert list(found) == list(info)
            assert all(same(found[key], value) for key, value in info.items())


@given(info=st.dictionaries(st.text(max_size=3), st.floats(allow_nan=False), min_size=1))
def test_a_schema_is_announced_once(info: dict[str, float]) -> None:
    """Infos with the same keys and types share a schema."""
    row = Row()
    assert row.through(info) == info
    assert row.through(info) == info
    assert len(row.announced) == 1


def test_a_decoded_info_is_a_copy() -> None:
    """Writing the row again doesn't change it."""
    row = Row()
    first = row.through({"x": np.arange(3)})
    assert first is not None
    row.through({"x": np.zeros(3, int)})
    assert first["x"].tolist() == [0, 1, 2]
    first["x"][0] = 9


@pytest.mark.parametrize(
    "info",
    [
        {"x": 2**64},
        {"x": "text"},
        {"x": {"nested": 1}},
        {1: 2.0},
        {"x": np.zeros(INFO_BYTES)},
        {"x": np.array([None])},
        {str(k): 0.0 for k in range(100)},
    ],
    ids=["big int", "text", "nested", "int key", "big array", "objects", "many"],
)
def test_an_info_that_does_not_fit_a_row_is_pickled(info: Any) -> None:
    """The mark says so; the next info that fits is written to the row."""
    row = Row()
    assert row.through(info) is None
    assert row.through({"y": 1.5}) == {"y": 1.5}


def test_a_worker_with_too_many_schemas_pickles_infos() -> None:
    """An env with ever-changing keys is slower, but correct."""
    row = Row()
    found = [row.through({f"key {k}": k}) for k in range(300)]
    announced = len(row.announced)
    assert announced < PICKLED
    assert found[:announced] == [{f"key {k}": k} for k in range(announced)]
    assert set(map(str, found[announced:])) == {"None"}
    assert row.through({"key 0": 7}) == {"key 0": 7}
