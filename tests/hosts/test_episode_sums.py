"""Sums of episodes, for every kind of autoreset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio._core.hosts.running.row_writer import EpisodeSums

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.types import Autoreset

MODES: list[Autoreset] = ["disabled", "next_step", "same_step"]
SHAPES: list[tuple[int, ...]] = [(), (3,), (2, 3)]


@dataclass
class Stream:
    """A naive model of one sub-environment (of one agent).

    Attributes:
        total, length: of the current episode, or the last one; length 0 if the last step belongs
            to no episode.
        over: it has ended and was not reset since.
        reset: it reset itself in the last step.
    """

    mode: Autoreset
    total: float = 0.0
    length: int = 0
    over: bool = False
    reset: bool = False

    def begin(self) -> None:
        self.total, self.length, self.over, self.reset = 0.0, 0, False, False

    def step(self, reward: float, *, ended: bool) -> None:
        self.reset = False
        if self.over and self.mode == "disabled":
            self.length = 0
            return
        if self.over and self.mode == "next_step":
            self.total, self.length, self.over, self.reset = 0.0, 0, False, True
            return
        if self.over:  # It reset itself in the step that ended the episode.
            self.total, self.length = 0.0, 0
        self.total += reward
        self.length += 1
        self.over = ended


class Both:
    """Sums with one stream for each; they must agree after every event."""

    def __init__(self, shape: tuple[int, ...], mode: Autoreset) -> None:
        self.row = np.zeros(shape), np.zeros(shape, np.int64), np.zeros(shape, np.bool_)
        self.sums = EpisodeSums(*self.row, mode)
        self.streams = np.empty(shape, object)
        for place in np.ndindex(shape):
            self.streams[place] = Stream(mode)

    def column(self, name: str) -> NDArray[Any]:
        values = [getattr(self.streams[p], name) for p in np.ndindex(self.streams.shape)]
        return np.array(values).reshape(self.streams.shape)

    def step(self, reward: NDArray[np.float64], ended: NDArray[np.bool_]) -> None:
        for place in np.ndindex(reward.shape):
            self.streams[place].step(float(reward[place]), ended=bool(ended[place]))
        found = self.sums.step(reward, ended if ended.any() else None)
        expected = self.column("reset")
        assert (found is None) == (not expected.any())
        if found is not None:
            assert found.tolist() == expected.tolist()
        self.check()

    def begin(self) -> None:
        for place in np.ndindex(self.streams.shape):
            self.streams[place].begin()
        self.sums.begin()
        self.check()

    def check(self) -> None:
        returns, lengths, over = self.row
        assert returns.tolist() == self.column("total").tolist()
        assert lengths.tolist() == self.column("length").tolist()
        assert over.tolist() == self.column("over").tolist()


def drawn_step(data: st.DataObject, shape: tuple[int, ...]) -> tuple[Any, Any]:
    size = int(np.prod(shape))
    rewards = data.draw(st.lists(st.integers(-9, 9), min_size=size, max_size=size))
    # Often no episode ends, which takes a shorter path.
    ends = st.just([False] * size) | st.lists(st.booleans(), min_size=size, max_size=size)
    ended = data.draw(ends)
    return np.array(rewards, float).reshape(shape), np.array(ended, bool).reshape(shape)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@given(data=st.data())
def test_sums_equal_those_of_separate_streams(
    mode: Autoreset, shape: tuple[int, ...], data: st.DataObject
) -> None:
    """Sub-environments and agents count as if each ran alone, in the given arrays."""
    both = Both(shape, mode)
    for _ in range(data.draw(st.integers(0, 20))):
        if data.draw(st.integers(0, 5)) == 0:
            both.begin()
        else:
            both.step(*drawn_step(data, shape))
