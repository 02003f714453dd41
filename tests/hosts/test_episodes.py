"""What counts as an episode, whoever resets it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.hosts.episodes import EpisodeSum, EpisodeSums

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.types import Autoreset

MODES: list[Autoreset] = ["disabled", "next_step", "same_step"]
steps = st.lists(st.tuples(st.integers(-9, 9), st.booleans()), max_size=30)


def naive_episodes(mode: Autoreset, stream: list[tuple[int, bool]]) -> list[Any]:
    """For each step the (return, length) of the episode that ended in it, or None."""
    found: list[Any] = []
    total, length, over = 0, 0, False
    for reward, ended in stream:
        if over:
            found.append(None)
            over = mode == "disabled"
            continue
        total, length = total + reward, length + 1
        found.append((total, length) if ended else None)
        if ended:
            total, length = 0, 0
            over = mode != "same_step"
    return found


def ends_of(ended: Any) -> NDArray[np.bool_]:
    """Episodes that end by truncation."""
    return np.stack((np.zeros_like(ended, bool), np.asarray(ended)), axis=-1)


@pytest.mark.parametrize("mode", MODES)
@given(streams=st.lists(steps, min_size=1, max_size=4))
def test_sums_are_those_of_each_stream_alone(
    mode: Autoreset, streams: list[list[tuple[int, bool]]]
) -> None:
    """Sub-environments that run together count as if each ran alone."""
    length = min(map(len, streams))
    sums = EpisodeSums((len(streams),), mode)
    expected = [naive_episodes(mode, stream[:length]) for stream in streams]
    for t in range(length):
        rewards = np.array([float(stream[t][0]) for stream in streams])
        ended = np.array([stream[t][1] for stream in streams])
        found = sums.add(rewards, ends_of(ended))
        if found is None:
            assert not ended.any()
            assert all(one[t] is None for one in expected)
            continue
        for k, one in enumerate(expected):
            assert (found[1][k] > 0) == (one[t] is not None)
            if one[t] is not None:
                assert (found[0][k], found[1][k]) == one[t]


@given(data=st.data(), mode=st.sampled_from(MODES))
def test_sub_environments_that_take_turns_keep_their_own_sums(
    data: st.DataObject, mode: Autoreset
) -> None:
    """Which of them a step is about decides, not where in the batch it stands."""
    together, alone = EpisodeSums((4,), mode), [EpisodeSums((), mode) for _ in range(4)]

    for _ in range(data.draw(st.integers(0, 30))):
        which = np.array(data.draw(st.permutations(range(4)))[:2], np.int32)
        rewards = np.array(data.draw(st.tuples(*[st.integers(-9, 9)] * 2)), float)
        ended = np.array(data.draw(st.tuples(*[st.booleans()] * 2)))
        found = together.add(rewards, ends_of(ended), which)
        for row, index in enumerate(which):
            single = alone[index].add(rewards[row], ends_of(ended[row]))
            if single is not None:
                assert found is not None
                assert (found[0][row], found[1][row]) == single
            elif found is not None:
                assert found[1][row] == 0


@pytest.mark.parametrize("mode", MODES)
def test_a_reset_forgets_the_episodes_under_way(mode: Autoreset) -> None:
    """What came before it is in no sum after it."""
    sums = EpisodeSums((2,), mode)
    sums.add(np.array([5.0, 5.0]), ends_of([True, False]))
    sums.forget()
    found = sums.add(np.array([1.0, 2.0]), ends_of([True, True]))
    assert found is not None
    assert found[0].tolist() == [1.0, 2.0]
    assert found[1].tolist() == [1, 1]


def test_an_episode_may_begin_with_a_later_result() -> None:
    """The first that is heard of a sub-environment after a reset is its start, not a step."""
    sums = EpisodeSums((3,), "next_step")
    sums.forget(begun=np.array([2]))
    both = np.array([0, 2])
    sums.add(np.array([0.0, 4.0]), ends_of([False, False]), both)
    found = sums.add(np.array([1.0, 1.0]), ends_of([True, True]), both)
    assert found is not None
    assert found[0].tolist() == [1.0, 5.0]
    assert found[1].tolist() == [1, 2]


@given(stream=steps)
def test_the_sum_of_a_single_env_is_the_same(stream: list[tuple[int, bool]]) -> None:
    """What comes after an end that nobody has reset belongs to no episode."""
    one, expected = EpisodeSum(), naive_episodes("disabled", stream)
    for (reward, ended), outcome in zip(stream, expected, strict=True):
        found = one.add(float(reward), ended)
        assert (found is None) == (not ended)
        if found is not None:
            assert found == (outcome or (0.0, 0))
    one.forget()
    assert one.add(2.0, True) == (2.0, 1)
