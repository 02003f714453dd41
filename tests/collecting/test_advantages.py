"""GAE and V-trace over chains, against formulas written out for one chain at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.collecting import Rollout

if TYPE_CHECKING:
    from collections.abc import Sequence


def rollout_of(
    rewards: Any, terminated: Any, truncated: Any, cuts: Sequence[int] = (), lengths: Any = None
) -> Rollout:
    """Chains of `lengths`, or a block; `cuts` are ends besides those of chains and episodes."""
    reward = np.asarray(rewards, np.float32)
    ends = np.asarray(terminated, bool), np.asarray(truncated, bool)
    columns = {"reward": reward, "terminated": ends[0], "truncated": ends[1]}
    columns["done"] = ends[0] | ends[1]
    columns["index"] = np.zeros(reward.shape, np.int64)
    if reward.ndim > 1:
        steps, envs = reward.shape
        lasts = np.arange(envs) + (steps - 1) * envs
    else:
        lasts = np.cumsum(lengths) - 1
    others = np.union1d(np.flatnonzero(columns["done"]), np.array(cuts, int))
    places = np.concatenate([lasts, np.setdiff1d(others, lasts)]).astype(np.intp)
    empty = np.zeros((len(places), 1))
    return Rollout(columns, places, empty, {}, {})


def cleanrl(
    rewards: Any, dones: Any, values: Any, next_value: Any, next_done: Any, gamma: float, lam: float
) -> Any:
    """CleanRL's ppo.py, with `dones` before each step."""
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


def test_v_trace_by_hand() -> None:
    """Ratios are clipped at 1; values after an end don't affect those before it."""
    rollout = rollout_of([1, 2], [0, 0], [0, 0], lengths=[2])
    targets, advantages = rollout.vtrace(np.array([4.0, 8.0]), [6.0], np.log([0.5, 4.0]), 0.5)
    # Errors: .5 * (1 + 4 - 4) = .5 and 1 * (2 + 3 - 8) = -3; targets 8 - 3 and 4 + .5 + .25 * -3.
    assert targets.tolist() == [3.75, 5.0]
    # The errors are .5 and -3, the targets of the last 5 and of the first 4 + .5 - .75.
    assert advantages.tolist() == [-0.25, -3.0]


@given(st.integers(1, 7), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_a_block_equals_cleanrl_to_the_bit(steps: int, envs: int, seed: int) -> None:
    """With values of 0 at truncations, which CleanRL treats as terminations."""
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.random((2, steps, envs)) < 0.2
    rollout = rollout_of(rng.normal(size=(steps, envs)), terminated, truncated)
    values = rng.normal(size=(steps, envs)).astype(np.float32)
    next_values = rng.normal(size=len(rollout.ends)).astype(np.float32)
    dones = np.concatenate([np.zeros((1, envs)), terminated | truncated]).astype(np.float32)
    expected = cleanrl(
        rollout.reward, dones[:-1], values, next_values[:envs], dones[-1], 0.99, 0.95
    )
    next_values[rollout.truncated.reshape(-1)[rollout.ends]] = 0.0
    found = rollout.advantages(values, next_values, 0.99, 0.95)
    assert found.shape == (steps, envs)
    np.testing.assert_array_equal(found, expected)


def test_each_agent_has_its_own_advantages() -> None:
    """Values after an agent's end don't affect those before it, though the env continues."""
    block = rollout_of([1, 2], [0, 1], [0, 0], lengths=[2])
    columns = {
        name: {"a": block[name], "b": 2 * block[name] if name == "reward" else ~block[name]}
        for name in ("reward", "terminated", "truncated", "done")
    }
    columns["index"] = block.index
    both = Rollout(columns, block.ends, np.zeros((1, 1)), {}, {})
    values = {"a": np.zeros(2), "b": np.zeros(2)}
    found = both.advantages(values, {"a": [9.0], "b": [9.0]}, 0.5, 1.0)
    assert found["a"].tolist() == [1 + 0.5 * 2, 2.0]
    assert found["b"].tolist() == [2.0, 4 + 0.5 * 9]
    ratios = {"a": np.zeros(2), "b": np.zeros(2)}
    traced = both.vtrace(values, {"a": [9.0], "b": [9.0]}, ratios, 0.5)
    assert {agent: own[0].tolist() for agent, own in traced.items()} == {
        "a": [2.0, 2.0],
        "b": [2.0, 8.5],
    }


def naive(
    rewards: Any, terminated: Any, ends: Any, values: Any, next_values: dict[int, float], rhos: Any
) -> tuple[list[float], list[float]]:
    """Targets and advantages of V-trace for one chain, transition by transition, last first.

    Nothing follows at `ends`; `next_values` are those after each of them. With clipped ratios
    `rhos` of 1, targets less values are the advantages of GAE.
    """
    targets, advantages, correction = [0.0] * len(rewards), [0.0] * len(rewards), 0.0
    for t in reversed(range(len(rewards))):
        if ends[t]:
            correction, value, target = 0.0, next_values[t], next_values[t]
        else:
            value, target = values[t + 1], targets[t + 1]
        if terminated[t]:
            value = target = 0.0
        error = rhos[t] * (rewards[t] + 0.97 * value - values[t])
        correction = error + 0.97 * 0.9 * rhos[t] * correction
        targets[t] = values[t] + correction
        advantages[t] = rhos[t] * (rewards[t] + 0.97 * target - values[t])
    return targets, advantages


NOT_FINITE = [np.nan, np.inf, -np.inf]


@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=6),
    st.booleans(),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1.0, 1.3]),
    st.data(),
)
def test_gae_and_v_trace_equal_the_formulas_chain_by_chain(
    lengths: list[int], block: bool, seed: int, clip: float, data: Any
) -> None:
    """In blocks and in chains that are cut anywhere; values after a termination are ignored, even
    if they are NaN or infinite.
    """
    if block:
        lengths = lengths[:1] * len(lengths)
    rng, count = np.random.default_rng(seed), sum(lengths)
    terminated, truncated = rng.random((2, count)) < 0.3
    rewards, values, log_ratios = rng.normal(size=(3, count))
    places = np.arange(count)
    chains = np.split(places, np.cumsum(lengths)[:-1])
    if block:
        shape = (lengths[0], len(lengths))
        chains = [*places.reshape(shape).T]
        terminated, truncated, rewards, values, log_ratios = (
            column.reshape(shape) for column in (terminated, truncated, rewards, values, log_ratios)
        )
    cuts = np.flatnonzero(rng.random(count) < 0.1)
    rollout = rollout_of(rewards, terminated, truncated, cuts, lengths)
    next_values = rng.normal(size=len(rollout.ends))
    over = np.flatnonzero(rollout.terminated.reshape(-1)[rollout.ends])
    next_values[over] = [data.draw(st.sampled_from(NOT_FINITE)) for _ in over]
    after = dict(zip(rollout.ends.tolist(), next_values.tolist(), strict=True))
    gains = rollout.advantages(values, next_values, 0.97, 0.9)
    all_targets, all_advantages = rollout.vtrace(
        values, next_values, log_ratios, 0.97, 0.9, clip=clip
    )
    for chain in chains:
        reward = rollout.reward.astype(float)
        own = [column.reshape(-1)[chain] for column in (reward, terminated, values)]
        ends = {k: after[place] for k, place in enumerate(chain.tolist()) if place in after}
        last = [k in ends for k in range(len(chain))]
        targets, _ = naive(own[0], own[1], last, own[2], ends, np.ones(len(chain)))
        np.testing.assert_allclose(gains.reshape(-1)[chain], targets - own[2], atol=1e-9)
        rhos = np.minimum(np.exp(log_ratios.reshape(-1)[chain]), clip)
        targets, advantages = naive(own[0], own[1], last, own[2], ends, rhos)
        np.testing.assert_allclose(all_targets.reshape(-1)[chain], targets, atol=1e-9)
        np.testing.assert_allclose(all_advantages.reshape(-1)[chain], advantages, atol=1e-9)


@pytest.mark.parametrize("number", NOT_FINITE)
def test_values_after_an_agents_end_are_ignored(number: float) -> None:
    """The env continues without the agent, whose later rows are not part of the chain."""
    block = rollout_of([1, 2, 3], [0, 1, 0], [0, 0, 0], lengths=[3])
    ends = np.array([2], np.intp)
    columns = {name: {"a": block[name]} for name in ("reward", "terminated", "truncated", "done")}
    columns["index"] = block.index
    rollout = Rollout(columns, ends, np.zeros((1, 1)), {}, {})
    values = {"a": np.array([0.0, 0.0, number])}
    gains = rollout.advantages(values, {"a": [9.0]}, 0.5, 1.0)
    assert gains["a"][:2].tolist() == [1 + 0.5 * 2, 2.0]
    with np.errstate(invalid="ignore"):  # Of the later rows themselves.
        traced: Any = rollout.vtrace(values, {"a": [9.0]}, {"a": np.zeros(3)}, 0.5)
    assert traced["a"][0][:2].tolist() == [2.0, 2.0]
    assert traced["a"][1][:2].tolist() == [2.0, 2.0]


@pytest.mark.parametrize("shape", [(2, 3), (6,), (3, 2, 1)])
def test_a_shape_other_than_the_rollouts_raises(shape: tuple[int, ...]) -> None:
    """Even with the same size, such as ``[N, T]`` for a block."""
    block = rollout_of(np.ones((3, 2)), np.zeros((3, 2)), np.zeros((3, 2)))
    right, wrong, after = np.zeros((3, 2)), np.zeros(shape), np.zeros(2)
    named = rf"has shape \[{', '.join(map(str, shape))}\].* shape \[3, 2\]"
    with pytest.raises(ValueError, match=f"^values {named}"):
        block.advantages(wrong, after, 0.99, 0.95)
    with pytest.raises(ValueError, match=f"^values {named}"):
        block.vtrace(wrong, after, right, 0.99)
    with pytest.raises(ValueError, match=f"^log_ratios {named}"):
        block.vtrace(right, after, wrong, 0.99)
    with pytest.raises(ValueError, match=r"^next_values has shape \[2, 1\].* 2 ends.*: \[2\]"):
        block.advantages(right, after[:, None], 0.99, 0.95)
