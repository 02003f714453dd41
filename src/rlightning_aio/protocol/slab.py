"""The slab: one block of shared memory with a row for each env of the same layout.

A row holds a request (action, seed) and its reply (observation, reward, flags, info, times).
Columns are contiguous, so one copy for each column reads or writes any number of rows.
Invariant: the trainer writes a row only while the env has no request in flight; the worker writes
it only while the env has one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import prod
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol.columns import Leaf, assemble, leaves, structure
from rlightning_aio.protocol.info import INFO_BYTES, INFO_BYTES_OF_SUB_ENV
from rlightning_aio.trees import walked

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.trees import Tree
    from rlightning_aio.types import EnvMeta

NO_SEED: Final = -1
AS_BEFORE: Final = -2
"""In place of a seed: those of the last reset, and its options, where the env knows them."""
TERMINATED: Final = 0
TRUNCATED: Final = 1
IS_RESET: Final = 2
OVER: Final = 3
"""Positions of the flags in their column."""
_ALIGNMENT: Final = 64


@dataclass(frozen=True)
class RowLayout:
    """The layout of a row. Envs with equal `key` share a slab and stack into one batch.

    Attributes:
        observation_space, action_space: of the env.
        head: shape of reward and flags: ``()``, ``(num_envs,)``, and with agents
            ``(num_agents, ...)``.
        agents: agent names of a multi-agent env.
        observations_out_of_band: observations are passed as objects (inline placement).
        key: equal for layouts with interchangeable rows and stackable observations, whose actions
            may hold infinity in the same places.
    """

    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    head: tuple[int, ...]
    agents: tuple[str, ...]
    observations_out_of_band: bool = False
    key: tuple[object, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # Where the env is built; the key travels with the layout.
        observations = structure(self.observation_space), self.observations_out_of_band
        key = (*observations, structure(self.action_space, limits=True), self.head, self.agents)
        object.__setattr__(self, "key", key)

    @classmethod
    def of(cls, meta: EnvMeta, *, observations_out_of_band: bool = False) -> RowLayout:
        """Return the layout of the row of an env.

        Args:
            meta: of the env.
            observations_out_of_band: see the class; without effect on observations that don't fit
                a row anyway.

        Raises:
            TypeError: the env reports no observation space, or no action space.
        """
        observations, actions = meta.observation_space, meta.action_space
        if observations is None or actions is None:
            missing = "observation" if observations is None else "action"
            raise TypeError(f"env {meta.env_id!r} reports no {missing} space")
        agents = (len(meta.agents),) if meta.agents else ()
        sub_envs = (meta.num_envs,) if meta.num_envs > 1 else ()
        hands_over = observations_out_of_band and leaves(observations) is not None
        return cls(observations, actions, (*agents, *sub_envs), meta.agents, hands_over)

    @property
    def observation_leaves(self) -> tuple[Leaf, ...] | None:
        """Arrays of an observation, or None if observations are not in the row."""
        return None if self.observations_out_of_band else leaves(self.observation_space)

    @property
    def action_leaves(self) -> tuple[Leaf, ...] | None:
        """Arrays of an action, or None if actions are pickled."""
        return leaves(self.action_space)

    def _arrays(self) -> Iterator[tuple[tuple[int, ...], np.dtype[Any]]]:
        for leaf in (*(self.observation_leaves or ()), *(self.action_leaves or ())):
            yield leaf.shape, leaf.dtype
        yield self.head, np.dtype(np.float64)
        yield (*self.head, 4), np.dtype(np.bool_)
        yield self.head, np.dtype(np.float64)
        yield self.head, np.dtype(np.int64)
        yield (), np.dtype(np.uint8)
        yield (), np.dtype(np.int64)
        yield (2,), np.dtype(np.int64)
        yield (max(INFO_BYTES, prod(self.head) * INFO_BYTES_OF_SUB_ENV),), np.dtype(np.uint8)

    def size(self, rows: int) -> int:
        """Size in bytes of a slab with `rows` rows."""
        return sum(_aligned(rows * prod(shape) * dtype.itemsize) for shape, dtype in self._arrays())

    def arrays(self, buffer: memoryview, rows: int) -> Iterator[NDArray[Any]]:
        """Yield the columns over `buffer`, in a fixed order."""
        offset = 0
        for shape, dtype in self._arrays():
            count = rows * prod(shape)
            # A pickled dtype equals those of arrays but isn't identical to them; a new one is, as
            # the comparison by identity in `columns.row_writer` needs.
            own = np.dtype(dtype.str)
            yield np.frombuffer(buffer, own, count, offset).reshape(rows, *shape)
            offset += _aligned(count * dtype.itemsize)


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def rows_for(
    layouts: Sequence[RowLayout],
) -> tuple[list[tuple[RowLayout, int]], list[tuple[int, int]]]:
    """Give each env a row in the slab of its layout.

    Returns the layout and the number of rows of each slab, and each env's slab and row.
    """
    slabs: dict[tuple[object, ...], list[RowLayout]] = {}
    rows: list[int] = []
    for layout in layouts:
        own = slabs.setdefault(layout.key, [])
        rows.append(len(own))
        own.append(layout)
    index = {key: k for k, key in enumerate(slabs)}
    places = [(index[layout.key], row) for layout, row in zip(layouts, rows, strict=True)]
    return [(own[0], len(own)) for own in slabs.values()], places


class Slab:
    """Columns over one block of memory; both sides map the same block.

    Attributes:
        observation, action: trees of ``[rows, ...]``; None if they are pickled.
        action_columns: the arrays of `action`, each with its leaf.
        reward: ``[rows, *head]`` float64.
        flags: ``[rows, *head, 4]`` bool; terminated, truncated, is_reset and over are its
            columns. ``is_reset``: no transition ends here. ``over``: the episode has ended,
            here or before, and nothing has reset it since.
        episode_return: ``[rows, *head]`` float64, episode_length: ``[rows, *head]`` int64;
            of the episode in progress or ending here, including this step; length 0 if the step
            belongs to no episode.
        info_mark: ``[rows]`` uint8, see `info`; info: ``[rows, bytes]`` uint8.
        seed: ``[rows]`` int64, seed of the reset plus 1, or 0 for none (see `AS_BEFORE`).
        times: ``[rows, 2]`` int64; its columns are done_ns, the monotonic time at which the
            reply was ready, and busy_ns, the time that the env took.
        sent_ns: ``[rows]`` int64, ns since the epoch by the env's clock if that differs from the
            trainer's, else None; not in the block of memory.
    """

    def __init__(self, layout: RowLayout, buffer: memoryview, rows: int) -> None:
        self.layout = layout
        self.rows = rows
        arrays = layout.arrays(buffer, rows)
        self.observation: Tree | None = None
        if layout.observation_leaves is not None:
            self.observation = assemble(layout.observation_space, arrays)
        self.action: Tree | None = None
        self.action_columns: list[tuple[Leaf, NDArray[Any]]] = []
        if (action_leaves := layout.action_leaves) is not None:
            self.action = assemble(layout.action_space, arrays)
            columns = [column for _, column in walked(self.action)]
            self.action_columns = [*zip(action_leaves, columns, strict=True)]
        self.reward = next(arrays)
        self.flags = next(arrays)
        self.terminated, self.truncated = self.flags[..., TERMINATED], self.flags[..., TRUNCATED]
        self.is_reset, self.over = self.flags[..., IS_RESET], self.flags[..., OVER]
        self.episode_return = next(arrays)
        self.episode_length = next(arrays)
        self.info_mark = next(arrays)
        self.seed = next(arrays)
        self.times = next(arrays)
        self.done_ns, self.busy_ns = self.times[:, 0], self.times[:, 1]
        self.info = next(arrays)
        self.sent_ns: NDArray[np.int64] | None = None

    def take_as_before(self, row: int) -> bool:
        """Return True if `AS_BEFORE` was sent to `row`, and clear it."""
        asked = bool(self.seed[row] == AS_BEFORE + 1)
        if asked:
            self.seed[row] = 0
        return asked

    def take_seed(self, row: int) -> int | None:
        """Return the seed of the reset that was sent to `row`, and clear it."""
        seed = int(self.seed[row])
        self.seed[row] = 0
        return seed - 1 if seed > 0 else None
