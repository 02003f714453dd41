"""Compares the vector interface with Gymnasium's under random operations."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from vector.toys import assert_alike, toy

from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted
from rlightning_aio.vector import VectorEnv, make_vec

SIZE = 3
NUM_EXAMPLES = 6 if "RLIGHTNING_AIO_EXAMPLES" not in os.environ else settings().max_examples
MODES = list(AutoresetMode)
seeds = st.none() | st.integers(0, 99) | st.lists(
    st.none() | st.integers(0, 99), min_size=SIZE, max_size=SIZE + 1
)  # fmt: skip
masks = st.lists(st.booleans(), min_size=SIZE, max_size=SIZE).map(np.array)
OPTIONS = (None, {}, {"more": 1})
Doing = tuple[Any, ...]


def doings(
    action: st.SearchStrategy[Any], calls: list[Any], attributes: list[str], assignments: list[Any]
) -> st.SearchStrategy[Doing]:
    """Operations on envs with such methods and attributes."""
    step = st.tuples(st.just("step"), st.lists(action, min_size=SIZE, max_size=SIZE))
    return st.one_of(
        step,
        step,
        st.tuples(st.just("reset"), seeds, st.none() | masks, st.sampled_from(OPTIONS)),
        st.tuples(st.just("call"), st.sampled_from(calls)),
        st.tuples(st.just("get_attr"), st.sampled_from(attributes)),
        st.tuples(st.just("set_attr"), st.sampled_from(assignments)).map(lambda d: (d[0], *d[1])),
        st.tuples(st.just("render")),
    )


def histories(doings: st.SearchStrategy[Doing]) -> st.SearchStrategy[list[Doing]]:
    """Operations, a close, and operations after it."""
    parts = st.tuples(
        st.lists(doings, min_size=1, max_size=25),
        st.just([("close",)]),
        st.lists(doings | st.tuples(st.just("close")), max_size=3),
    )
    return parts.map(lambda parts: [doing for part in parts for doing in part])


TOY = doings(
    st.integers(0, 2),
    [("double", 2.0), ("own",), ("no_such",)],
    ["speed", "own", "render_mode"],
    [(name, value) for name in ("speed", "own") for value in (0.5, [1.0, 2.0, 3.0], (1.0, 2.0))],
)
TOGETHER = doings(
    st.integers(0, 99),
    [("np_random_seed",), ("_elapsed_steps",), ("init_qpos",), ("no_such",)],
    ["dt", "_max_episode_steps", "render_mode", "np_random_seed"],
    [
        ("frame_skip", 3),
        ("frame_skip", [1, 1, 1]),
        ("_max_episode_steps", 4),
        ("own", (1.0, 2.0)),
    ],
)
"""Operations on simulations that share a model, whose methods can't be called; a step has seeds."""
TASKS = ("InvertedPendulum-v5", "Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Humanoid-v5")


def actions_of(env: Any, given: list[Any]) -> Any:
    """The actions of a step; for a space of floats, samples by the numbers that are given."""
    if isinstance(env.single_action_space, gym.spaces.Discrete):
        return np.array(given, env.action_space.dtype)
    env.action_space.seed(given[0])
    return env.action_space.sample()[: len(given)]


def outcome(env: Any, doing: tuple[Any, ...], due: np.ndarray) -> Any:
    """Result of an operation, or its error."""
    what, *arguments = doing
    if what == "step" and env.autoreset_mode == AutoresetMode.DISABLED and due.any():
        what, arguments = "reset", [None, due.copy(), None]
    try:
        if what == "step":
            return env.step(actions_of(env, arguments[0]))
        if what == "reset":
            seed, mask, options = arguments
            if mask is not None:
                options = {"reset_mask": mask, **(options or {})}
            return env.reset(seed=seed, options=options)
        if what == "call":
            return env.call(*arguments[0])
        if what == "get_attr":
            return env.get_attr(*arguments)
        if what == "set_attr":
            return env.set_attr(*arguments)
        return env.close() if what == "close" else env.render()
    except ClosedEnvironmentError:
        return "closed"
    except (ValueError, TypeError, AttributeError) as error:
        kinds = ValueError, TypeError, AttributeError
        return next(kind for kind in kinds if isinstance(error, kind))


def compare(ours: Any, theirs: Any, did: list[Doing], seed: int) -> None:
    """Do it to both; a closed one raises like `AsyncVectorEnv`, not like `SyncVectorEnv`."""
    due = np.zeros(SIZE, np.bool_)
    assert_alike(ours.reset(seed=seed), theirs.reset(seed=seed))
    for turn, doing in enumerate(did):
        refused = ours.closed and doing[0] != "close"
        found = outcome(ours, doing, due)
        expected = "closed" if refused else outcome(theirs, doing, due)
        assert_alike(found, expected, f"{turn}: {doing}")
        if isinstance(expected, tuple) and len(expected) == 5 and doing[0] == "step":
            due = expected[2] | expected[3]
        elif doing[0] == "reset" and isinstance(expected, tuple):
            due = due & ~doing[2] if doing[2] is not None else np.zeros(SIZE, np.bool_)
        elif doing[0] == "step" and isinstance(expected, tuple):
            due = np.zeros(SIZE, np.bool_)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
@given(did=histories(TOY), seed=st.integers(0, 99))
def test_it_does_the_same_as_gymnasiums(mode: AutoresetMode, did: list[Any], seed: int) -> None:
    """Resets with seeds and masks, steps over episode ends, calls, attributes, frames, errors."""
    ours = VectorEnv([toy] * SIZE, autoreset_mode=mode, placement="inline")
    compare(ours, SyncVectorEnv([toy] * SIZE, autoreset_mode=mode), did, seed)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
@pytest.mark.parametrize("task", TASKS)
def test_envs_that_are_stepped_together_do_the_same(task: str, mode: AutoresetMode) -> None:
    """Simulations of one model, whose Gymnasium env takes the state of each in turn."""
    arguments, kwargs = {"autoreset_mode": mode}, {"max_episode_steps": 7}

    @settings(max_examples=NUM_EXAMPLES)
    @given(histories(TOGETHER), st.integers(0, 99), st.sampled_from([0.1, 2.0]))
    def check(did: list[Any], seed: int, weight: float) -> None:
        with outdated_assets_accepted():
            ours = make_vec(task, SIZE, vector_kwargs=arguments, **kwargs)
            theirs = gym.make_vec(task, SIZE, "sync", arguments, **kwargs)
        compare(ours, theirs, [("set_attr", "_ctrl_cost_weight", weight), *did], seed)

    check()
