"""Random actions are in their space, and repeatable by seed."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio import BatchedData, EnvRet, MultiAgentEnvRet
from rlightning_aio.errors import ConfigError
from rlightning_aio.policies.random_actions import RandomPolicy

shapes = st.lists(st.integers(1, 3), min_size=1, max_size=2).map(tuple)
extremes = st.sampled_from([-np.inf, np.inf, 3e38, -3e38])
# Adding 0.0 leaves no -0.0: Gymnasium can't sample between 0.0 and -0.0.
floats = (st.floats(-1e6, 1e6, width=32) | extremes).map(lambda bound: bound + 0.0)
wholes = st.integers(-120, 120)


@st.composite
def boxes(draw: st.DrawFn) -> spaces.Box:
    """Boxes of any dtype with two bounds, one or none for each number."""
    shape = draw(shapes)
    dtype = draw(st.sampled_from([np.float32, np.float64, np.int8, np.int64]))
    bounds = floats if np.issubdtype(dtype, np.floating) else wholes
    ends = [sorted((draw(bounds), draw(bounds))) for _ in range(int(np.prod(shape)))]
    low, high = np.array(ends, np.float64).reshape(-1, 2).T
    low[low == np.inf], high[high == -np.inf] = -1.0, 1.0
    low, high = low.reshape(shape).astype(dtype), high.reshape(shape).astype(dtype)
    return spaces.Box(low, high, dtype=dtype)


leaves = st.one_of(
    boxes(),
    st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 9), wholes),
    st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 5), min_size=1, max_size=3)),
    st.builds(spaces.MultiBinary, st.integers(1, 4)),
    st.builds(spaces.Text, st.integers(1, 4)),
)
any_space: st.SearchStrategy[Any] = st.recursive(
    leaves,
    lambda inner: (
        st.dictionaries(st.sampled_from("abc"), inner, min_size=1).map(spaces.Dict)
        | st.lists(inner, min_size=1, max_size=3).map(spaces.Tuple)
    ),
    max_leaves=4,
)


def sample(space: gym.Space[Any], num_envs: int, seed: int) -> BatchedData:
    ids = [f"env-{k}" for k in range(num_envs)]
    policy = RandomPolicy(lambda env_id: space, seed)
    batch = BatchedData(ids, [None] * num_envs)
    return batch.respond(action=policy(batch))


@given(any_space, st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_random_actions_are_in_their_space(space: gym.Space[Any], num_envs: int, seed: int) -> None:
    """Each has the dtypes of the space."""
    responses = sample(space, num_envs, seed).values()
    assert len(responses) == num_envs
    for response in responses:
        assert space.contains(response.action), (space, response.action)


def test_bounded_numbers_are_spread_over_their_range() -> None:
    """Both halves of each dimension's range occur equally often."""
    space = spaces.Box(np.array([-1.0, 10.0]), np.array([1.0, 30.0]), dtype=np.float64)
    actions = sample(space, 4000, 0).action
    middle = (space.low + space.high) / 2
    assert np.abs((actions > middle).mean(axis=0) - 0.5).max() < 0.05


def test_unbounded_numbers_are_small() -> None:
    """Large ones would throw a robot about."""
    space = spaces.Box(-np.inf, np.inf, (2,))
    actions = sample(space, 1000, 0).action
    assert 0.05 < actions.std() < 0.2


MASK = np.array([0, 1, 0, 1, 0], np.int8)
FIVE = spaces.Discrete(5, start=-1)


def masked(form: str) -> tuple[gym.Space[Any], Any]:
    """Return an action space, and a result whose masks allow 0 and 2."""
    single = EnvRet(env_id="a-0", observation=0)
    mask = {"action_mask": MASK}
    match form:
        case "observation":
            return FIVE, single.model_copy(update={"observation": {"board": 0, **mask}})
        case "info":
            return FIVE, single.model_copy(update={"info": mask})
        case "vectorised":
            info = {"action_mask": np.stack([MASK, MASK])}
            space = spaces.MultiDiscrete([5, 5], start=[-1, -1])
            return space, single.model_copy(update={"info": info})
        case _:
            agents = spaces.Dict({"x": FIVE, "y": FIVE})
            return agents, MultiAgentEnvRet(
                env_id="a-0", observation={"x": mask, "y": 0}, info={"y": mask}
            )


@pytest.mark.parametrize("form", ["observation", "info", "vectorised", "agents"])
@pytest.mark.parametrize("company", [[], [("b-0", spaces.Discrete(3))]])
def test_random_actions_respect_masks(form: str, company: list[tuple[str, gym.Space[Any]]]) -> None:
    """Exactly the allowed actions occur, whatever other envs are in the batch."""
    space, result = masked(form)
    others = dict(company)
    policy = RandomPolicy({"a-0": space, **others}.__getitem__, 0)
    met: set[int] = set()
    for _ in range(40):
        batch = BatchedData(["a-0", *others], [result, *map(unmasked, others)])
        response, *rest = batch.respond(action=policy(batch)).values()
        assert space.contains(response.action)
        assert all(others[one.env_id].contains(one.action) for one in rest)
        action = response.action
        met.update(np.ravel(list(action.values()) if isinstance(action, dict) else action).tolist())
    assert met == {0, 2}


def unmasked(env_id: str) -> EnvRet:
    return EnvRet(env_id=env_id, observation=0)


def test_a_mask_without_allowed_actions_is_ignored() -> None:
    """It is another agent's turn: the action is ignored but must be in the space."""
    result = EnvRet(env_id="a-0", observation={"action_mask": 0 * MASK})
    policy = RandomPolicy(lambda env_id: FIVE, 0)
    batch = BatchedData(["a-0"], [result])
    met = {int(policy(batch)[0]) for _ in range(100)}
    assert met == {-1, 0, 1, 2, 3}


def test_an_env_without_an_action_space_needs_a_policy() -> None:
    """The message names the env."""
    policy = RandomPolicy(lambda env_id: None, 0)
    with pytest.raises(ConfigError, match="'a-0' reports no action space; give a policy"):
        policy(BatchedData(["a-0"], [None]))
