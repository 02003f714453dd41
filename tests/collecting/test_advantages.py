"""GAE and V-trace over chains, against formulas written out for one chain at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.collecting import Lag, Rollout, Seconds

if TYPE_CHECKING:
    from collections.abc import Sequence

NO_LAG, NO_TIME = Lag(0, 0.0, 0), Seconds(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def rollout_of(
    rewards: Any, terminated: Any, truncated: Any, cuts: Sequence[int] = (), lengths: Any = None
) -> Rollout:
    """Chains of `lengths`, or a block; `cuts` are ends beside those of chains and episodes."""
    reward = np.asarray(rewards, np.float32)
    ends = np.asarray(terminated, bool), np.asarray(truncated, bool)
    columns = {"reward": reward, "terminated": ends[0], "truncated": ends[1]}
    columns["done"] = ends[0] | ends[1]
    if reward.ndim > 1:
        steps, envs = reward.shape
        lasts = np.arange(envs) + (steps - 1) * envs
    else:
        lasts = np.cumsum(lengths) - 1
    others = np.union1d(np.flatnonzero(columns["done"]), np.array(cuts, int))
    places = np.concatenate([lasts, np.setdiff1d(others, lasts)]).astype(np.intp)
    empty = np.zeros((len(places), 1))
    return Rollout(columns, reward.shape, places, empty, len(lasts), NO_LAG, NO_TIME)


def cleanrl(
    rewards: Any, dones: Any, values: Any, next_value: Any, next_done: Any, gamma: float, lam: float
) -> Any:
    """As CleanRL's ppo.py has it, `dones` being those before each step."""
    advantages = np.zeros_like(rewards)
    last: Any = 0
    for t in reversed(range(len(rewards))):
        if t == len(rewards) - 1:
            going_on, next_values = 1.0 - next_done, next_value
        else:
            going_on, next_values = 1.0 - dones[t + 1], values[t + 1]
        delta = rewards[t] + gamma * next_values * going_on - values[t]
        advantages[t] = last = delta + gamma * lam * going_on * last
    return advantages


def test_an_example_by_hand() -> None:
    """A termination is worth nothing after, a truncation and a seam what is given for them."""
    rollout = rollout_of([1, 2, 3, 4], [0, 1, 0, 0], [0, 0, 1, 0], lengths=[4])
    values, next_values = [10.0, 20.0, 30.0, 40.0], [50.0, 60.0, 70.0]
    assert rollout.ends.tolist() == [3, 1, 2]
    found = rollout.advantages(np.array(values, np.float32), next_values, 0.5, 0.5)
    # Errors, last first: 4 + 25 - 40; 3 + 35 - 30; 2 + 0 - 20; and 1 + 10 - 10, with -18 / 4.
    assert found.tolist() == [-3.5, -18.0, 8.0, -11.0]
    assert found.dtype == np.float32


def test_v_trace_by_hand() -> None:
    """Ratios are clipped at 1; what comes after an end doesn't reach before it."""
    rollout = rollout_of([1, 2], [0, 0], [0, 0], lengths=[2])
    found = rollout.vtrace(np.array([4.0, 8.0]), [6.0], np.log([0.5, 4.0]), 0.5)
    # Errors: .5 * (1 + 4 - 4) = .5 and 1 * (2 + 3 - 8) = -3; targets 8 - 3 and 4 + .5 + .25 * -3.
    assert found.targets.tolist() == [3.75, 5.0]
    # The errors are .5 and -3, the targets of the last 5 and of the first 4 + .5 - .75.
    assert found.advantages.tolist() == [-0.25, -3.0]


@st.composite
def chains(draw: st.DrawFn) -> tuple[list[int], np.random.Generator]:
    lengths = draw(st.lists(st.integers(1, 9), min_size=1, max_size=6))
    return lengths, np.random.default_rng(draw(st.integers(0, 2**32 - 1)))


def segment_by_segment(rollout: Rollout, function: Any) -> None:
    """Call `function` with each segment's slice and the number of its end, in their order."""
    order = np.argsort(rollout.ends)
    begin = 0
    for k in order.tolist():
        end = int(rollout.ends[k]) + 1
        function(slice(begin, end), k)
        begin = end


@given(chains())
def test_gae_equals_the_formula_chain_by_chain(case: tuple[list[int], Any]) -> None:
    lengths, rng = case
    count = sum(lengths)
    terminated, truncated = rng.random((2, count)) < 0.2
    cuts = np.flatnonzero(rng.random(count) < 0.1)
    rollout = rollout_of(rng.normal(size=count), terminated, truncated, cuts, lengths)
    values, next_values = rng.normal(size=count), rng.normal(size=len(rollout.ends))
    found = rollout.advantages(values, next_values, 0.97, 0.9)
    expected = np.zeros(count)

    def expect(rows: slice, k: int) -> None:
        after = next_values[k] * (not terminated[rows.stop - 1])
        later = 0.0
        for t in reversed(range(rows.start, rows.stop)):
            error = rollout.reward[t] + 0.97 * after - values[t]
            expected[t] = later = error + 0.97 * 0.9 * later
            after = values[t]

    segment_by_segment(rollout, expect)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@given(chains())
def test_v_trace_equals_the_papers_sum(case: tuple[list[int], Any]) -> None:
    """v_s = V(x_s) + sum over t of gamma^(t-s) (c_s … c_(t-1)) delta_t V."""
    lengths, rng = case
    count = sum(lengths)
    terminated, truncated = rng.random((2, count)) < 0.2
    rollout = rollout_of(rng.normal(size=count), terminated, truncated, (), lengths)
    values, next_values = rng.normal(size=count), rng.normal(size=len(rollout.ends))
    log_ratios = rng.normal(size=count)
    found = rollout.vtrace(values, next_values, log_ratios, 0.97, 0.9, clip_rho=1.3, clip_c=1.1)
    rho = np.minimum(np.exp(log_ratios), 1.3)
    c = 0.9 * np.minimum(np.exp(log_ratios), 1.1)

    def check(rows: slice, k: int) -> None:
        last = next_values[k] * (not terminated[rows.stop - 1])
        after = np.append(values[rows][1:], last)
        delta = rho[rows] * (rollout.reward[rows] + 0.97 * after - values[rows])
        length = rows.stop - rows.start
        targets = [
            values[rows][s]
            + sum(0.97 ** (t - s) * np.prod(c[rows][s:t]) * delta[t] for t in range(s, length))
            for s in range(length)
        ]
        np.testing.assert_allclose(found.targets[rows], targets, rtol=1e-9, atol=1e-12)
        after = np.append(targets[1:], last)
        advantages = rho[rows] * (rollout.reward[rows] + 0.97 * after - values[rows])
        np.testing.assert_allclose(found.advantages[rows], advantages, rtol=1e-9, atol=1e-12)

    segment_by_segment(rollout, check)


@given(st.integers(1, 7), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_a_block_equals_cleanrl_to_the_bit(steps: int, envs: int, seed: int) -> None:
    """With values of 0 where an episode is truncated, as CleanRL takes that for its end."""
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.random((2, steps, envs)) < 0.2
    rollout = rollout_of(rng.normal(size=(steps, envs)), terminated, truncated)
    values = rng.normal(size=(steps, envs)).astype(np.float32)
    next_values = rng.normal(size=len(rollout.ends)).astype(np.float32)
    dones = np.concatenate([np.zeros((1, envs)), terminated | truncated]).astype(np.float32)
    expected = cleanrl(
        rollout.reward, dones[:-1], values, next_values[:envs], dones[-1], 0.99, 0.95
    )
    next_values[rollout.at_ends("truncated")] = 0.0
    found = rollout.advantages(values, next_values, 0.99, 0.95)
    assert found.shape == (steps, envs)
    np.testing.assert_array_equal(found, expected)


def test_agents_have_advantages_of_their_own() -> None:
    """What follows an agent's end doesn't reach before it, though the env goes on."""
    block = rollout_of([1, 2], [0, 1], [0, 0], lengths=[2])
    columns = {
        name: {"a": block[name], "b": 2 * block[name] if name == "reward" else ~block[name]}
        for name in ("reward", "terminated", "truncated", "done")
    }
    both = Rollout(columns, (2,), block.ends, np.zeros((1, 1)), 1, NO_LAG, NO_TIME)
    values = {"a": np.zeros(2), "b": np.zeros(2)}
    found = both.advantages(values, {"a": [9.0], "b": [9.0]}, 0.5, 1.0)
    assert found["a"].tolist() == [1 + 0.5 * 2, 2.0]
    assert found["b"].tolist() == [2.0, 4 + 0.5 * 9]
    ratios = {"a": np.zeros(2), "b": np.zeros(2)}
    traced = both.vtrace(values, {"a": [9.0], "b": [9.0]}, ratios, 0.5)
    assert {agent: own.targets.tolist() for agent, own in traced.items()} == {
        "a": [2.0, 2.0],
        "b": [2.0, 8.5],
    }


@pytest.mark.parametrize(("values", "next_values", "named"), [(3, 1, "values"), (2, 2, "next_")])
def test_wrong_shapes_are_named(values: int, next_values: int, named: str) -> None:
    rollout = rollout_of([1, 2], [0, 0], [0, 0], lengths=[2])
    with pytest.raises(ValueError, match=named):
        rollout.advantages(np.zeros(values), np.zeros(next_values), 0.99, 0.95)
