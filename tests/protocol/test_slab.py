"""Rows: values of any space are read as written, and don't affect other rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from remote.random_spaces import any_space, same, sampled

from rlightning_aio.protocol.columns import Misfit, leaves, row_reader, row_writer
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.trees import index

fixed_space = any_space.filter(lambda space: leaves(space) is not None)
HEADS = st.sampled_from([((), ()), ((3,), ()), ((2,), ("a", "b")), ((2, 3), ("a", "b"))])


@given(
    observations=fixed_space,
    actions=fixed_space,
    head=HEADS,
    rows=st.integers(1, 4),
    seed=st.integers(0, 99),
)
@settings(deadline=None)
def test_values_go_through_rows_unchanged(
    observations: Any, actions: Any, head: Any, rows: int, seed: int
) -> None:
    """One side reads what the other wrote, with the same dtype; each row keeps its value."""
    layout = RowLayout(observations, actions, *head)
    memory = memoryview(bytearray(layout.size(rows)))
    ours, theirs = Slab(layout, memory, rows), Slab(layout, memory, rows)
    sent = [sampled(actions, seed + row) for row in range(rows)]
    seen = [sampled(observations, seed + row) for row in range(rows)]
    for row in range(rows):
        row_writer(ours.action, row, "action")(sent[row])
        row_writer(theirs.observation, row, "observation")(seen[row])
        theirs.reward[row] = row
        theirs.terminated[row] = row % 2
        theirs.over[row] = row % 3 > 0
        theirs.episode_return[row] = row / 2
        theirs.episode_length[row] = row
        theirs.info[row] = row
    for row in range(rows):
        assert same(row_reader(theirs.action, row)(), sent[row])
        assert same(index(ours.observation, row), seen[row])
        assert (ours.reward[row] == row).all()
        assert (ours.terminated[row] == bool(row % 2)).all()
        assert not ours.truncated[row].any()
        assert not ours.is_reset[row].any()
        assert (ours.over[row] == (row % 3 > 0)).all()
        assert (ours.episode_return[row] == row / 2).all()
        assert (ours.episode_length[row] == row).all()
        assert (ours.info[row] == row).all()


@given(space=fixed_space)
@settings(deadline=None)
def test_a_value_read_for_an_env_is_a_copy(space: Any) -> None:
    """The next request may write the row while the env still uses the last action."""
    layout = RowLayout(spaces.Discrete(2), space, (), ())
    slab = Slab(layout, memoryview(bytearray(layout.size(1))), 1)
    one, other = sampled(space, 1), sampled(space, 2)
    write = row_writer(slab.action, 0, "action")
    write(one)
    read = row_reader(slab.action, 0)()
    write(other)
    assert same(read, one)


@given(space=fixed_space, other=fixed_space)
@settings(deadline=None)
def test_rows_with_equal_keys_have_the_same_layout(space: Any, other: Any) -> None:
    """Envs share a slab exactly if their rows have the same arrays at the same offsets."""
    one = RowLayout(space, spaces.Discrete(2), (), ())
    two = RowLayout(other, spaces.Discrete(2), (), ())
    assume(one.observation_leaves != two.observation_leaves)
    assert one.key != two.key
    assert one.key == RowLayout(space, spaces.Discrete(2, start=1), (), ()).key
    assert one.key != RowLayout(space, spaces.Discrete(2), (2,), ()).key
    assert one.key != RowLayout(space, spaces.Discrete(2), (2,), ("a", "b")).key


@pytest.mark.parametrize(
    ("space", "value", "said"),
    [
        (spaces.Box(0, 1, (3,)), np.zeros(2, np.float32), r"observation .*\(3,\).*\(2,\)"),
        (spaces.Box(0, 9, (3,), np.uint8), np.zeros(3), "uint8.*float64"),
        (spaces.Discrete(3), np.zeros(1, int), r"expected shape \(\).*\(1,\)"),
        (spaces.Discrete(3), 0.5, "int64.*float64"),
        (spaces.Dict(a=spaces.Discrete(2)), {"b": 0}, r"keys \['a'\], found keys \['b'\]"),
        (spaces.Dict(a=spaces.Discrete(2)), 3, "found int"),
        (spaces.Dict(a=spaces.Tuple([spaces.Discrete(2)])), {"a": (0, 0)}, r"\['a'\].*tuple of 1"),
        (spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 1, (2,))]), (0, [1]), r"\[1\].*\(2,\)"),
        (spaces.Box(0, 1, (1,)), "text", "dtype <U4"),
    ],
)
def test_a_misfit_names_position_and_difference(space: Any, value: Any, said: str) -> None:
    """Position, and shape and dtype both expected and found."""
    layout = RowLayout(space, spaces.Discrete(2), (), ())
    slab = Slab(layout, memoryview(bytearray(layout.size(1))), 1)
    with pytest.raises(Misfit, match=said):
        row_writer(slab.observation, 0, "observation")(value)
