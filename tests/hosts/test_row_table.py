"""Requests and results travel between two slabs as columns."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from group.sample_envs import MOVES, TREE
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio._core.hosts.ray.row_table import RowTable
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.slab import RowLayout, Slab

FIRST_SLOT = 7
WORDS = spaces.Text(5)
LAYOUTS = [
    RowLayout(TREE, MOVES, (), ()),
    RowLayout(spaces.Box(-1, 1, (2, 3)), spaces.MultiDiscrete([3, 3]), (2,), ()),
    RowLayout(WORDS, WORDS, (), ()),
]


def slab(layout: RowLayout, rows: int, fill: np.random.Generator | None = None) -> Slab:
    memory = bytearray(layout.size(rows))
    if fill is not None:
        memory[:] = fill.integers(0, 2, len(memory), np.uint8).tobytes()
    return Slab(layout, memoryview(memory), rows)


def arrays(tree: Any) -> list[Any]:
    if isinstance(tree, dict | tuple):
        parts = tree.values() if isinstance(tree, dict) else tree
        return [array for part in parts for array in arrays(part)]
    return [] if tree is None else [tree]


def outputs(slab: Slab, row: int) -> list[bytes]:
    columns = [
        *arrays(slab.observation),
        *(slab.reward, slab.flags, slab.episode_return, slab.episode_length),
        *(slab.busy_ns, slab.info_mark),
    ]
    return [column[row].tobytes() for column in columns]


def inputs(slab: Slab, row: int) -> list[bytes]:
    return [column[row].tobytes() for column in arrays(slab.action)]


envs = st.lists(st.integers(0, len(LAYOUTS) - 1), min_size=1, max_size=6)


@given(kinds=envs, data=st.data(), seed=st.integers(0, 2**32 - 1), seeds=st.booleans())
def test_only_the_rows_of_the_entries_travel(
    kinds: list[int], data: Any, seed: int, seeds: bool
) -> None:
    """This holds for all envs, layouts, and positions of rows on either side."""
    draw = np.random.default_rng(seed)
    # The slabs of the trainer also hold envs of other hosts, and the rows are in any order.
    ours = {kind: slab(LAYOUTS[kind], 9, draw) for kind in set(kinds)}
    theirs = {kind: slab(LAYOUTS[kind], kinds.count(kind)) for kind in set(kinds)}
    our_rows = {kind: draw.permutation(9).tolist() for kind in ours}
    their_rows = {kind: list(range(kinds.count(kind))) for kind in ours}
    here = [(ours[kind], our_rows[kind].pop()) for kind in kinds]
    there = [(theirs[kind], their_rows[kind].pop(0)) for kind in kinds]
    trainer, actor = RowTable(FIRST_SLOT, here), RowTable(FIRST_SLOT, there)
    asked = data.draw(st.lists(st.integers(0, len(kinds) - 1), min_size=1, unique=True))
    ops = [data.draw(st.sampled_from([Operation.STEP, Operation.RESET])) for _ in asked]
    entries = np.array(
        [entry(3, FIRST_SLOT + index, op) for index, op in zip(asked, ops, strict=True)], np.int64
    )

    wished = [int(s.seed[row]) for s, row in here]
    columns = trainer.requests(entries, seeds=seeds)
    actor.put_requests(entries, columns, seeds=seeds)
    for index, ((s, row), (t, its)) in enumerate(zip(here, there, strict=True)):
        op = dict(zip(asked, ops, strict=True)).get(index)
        assert inputs(t, its) == (
            inputs(s, row) if op == Operation.STEP else [bytes(len(b)) for b in inputs(t, its)]
        )
        took = seeds and op == Operation.RESET
        assert int(t.seed[its]) == (wished[index] if took else 0)
        assert int(s.seed[row]) == (0 if took else wished[index])

    before = [outputs(s, row) for s, row in here]
    for t in theirs.values():
        for column in (*arrays(t.observation), t.reward, t.flags, t.busy_ns, t.episode_length):
            column[...] = draw.integers(0, 2, column.shape).astype(column.dtype)
        t.info[:] = draw.integers(0, 255, t.info.shape, np.uint8)
        t.info_mark[:] = 1
    trainer.put_results(entries, actor.results(entries, 40), done_ns=99)
    for index, ((s, row), (t, its)) in enumerate(zip(here, there, strict=True)):
        assert outputs(s, row) == (outputs(t, its) if index in asked else before[index])
        if index in asked:
            assert (s.info[row, :40] == t.info[its, :40]).all()
            assert s.done_ns[row] == 99


def test_empty_infos_do_not_travel() -> None:
    """Their space is most of a row."""
    table = RowTable(FIRST_SLOT, [(slab(LAYOUTS[0], 2), 0)])
    (*_, info) = table.results(np.array([entry(1, FIRST_SLOT, Operation.STEP)]), 40)
    assert info.nbytes == 0


def test_spaces_without_a_fixed_size_have_no_column() -> None:
    """Their values travel out of band."""
    table = RowTable(FIRST_SLOT, [(slab(LAYOUTS[2], 1), 0)])
    asked = np.array([entry(1, FIRST_SLOT, Operation.STEP)])
    assert table.requests(asked, seeds=True) == []
    assert isinstance(LAYOUTS[2].action_space, gym.Space)
