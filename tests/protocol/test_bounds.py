"""Values outside of their space are described, without an error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.protocol.columns import out_of_bounds

BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)
LEAVES = [
    BOX,
    spaces.Box(0, 9, (), np.uint8),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 5]),
    spaces.MultiBinary(3),
    spaces.Text(4),
]
TREE = spaces.Dict(a=spaces.Tuple(LEAVES), b=spaces.Dict(c=BOX))


@given(st.integers(0, 2**31))
def test_members_are_within(seed: int) -> None:
    """Samples of any space are within it."""
    TREE.seed(seed)
    assert out_of_bounds(TREE, TREE.sample(), "it") is None


@pytest.mark.parametrize(
    ("space", "value", "said"),
    [
        (BOX, np.array([0, 3], np.float32), "it holds 3.0, and the space goes from -1.0 to 1.0"),
        (BOX, np.array([0, np.nan], np.float32), "it holds nan, and"),
        (LEAVES[2], 2, "it holds 2, and the space goes from -1 to 1"),
        (LEAVES[3], np.array([0, -1]), "it holds -1, and the space goes from 0 to 4"),
        (LEAVES[4], np.array([0, 1, 2]), "it holds 2, and the space goes from 0 to 1"),
        (TREE, {"b": {"c": np.full(2, -2.0)}}, "it['b']['c'] holds -2.0, and"),
        (TREE, {"a": (np.full(2, 7.0),)}, "it['a'][0] holds 7.0, and"),
    ],
)
def test_values_outside_are_described(space: Any, value: Any, said: str) -> None:
    """With position, value and bounds."""
    found = out_of_bounds(space, value, "it")
    assert found is not None
    assert found.startswith(said)


@pytest.mark.parametrize(
    "value", [None, "words", {}, (), np.zeros(3), np.array(["a", "b"]), [5, 5]]
)
@pytest.mark.parametrize("space", [BOX, TREE, TREE["a"]])
def test_values_with_another_structure_are_skipped(space: Any, value: Any) -> None:
    """Other checks report these."""
    assert out_of_bounds(space, value, "it") is None
