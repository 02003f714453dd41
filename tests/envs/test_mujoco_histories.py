"""Simulations that are stepped together equal separate envs, whatever is done between steps."""

from __future__ import annotations

import os
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from vector.toys import assert_alike

from rlightning_aio.envs.mujoco.batch import MujocoBatch
from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted
from rlightning_aio.envs.state import load_state, save_state

NUM_EXAMPLES = 6 if "RLIGHTNING_AIO_EXAMPLES" not in os.environ else settings().max_examples
NUM_ENVS = 3
LIMIT = 7
TASKS = ("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Humanoid-v5")
OPTIONS = {"_ctrl_cost_weight": st.sampled_from([0.1, 2.0]), "frame_skip": st.sampled_from([1, 3])}
"""Attributes that all of these tasks have, and that change what a step returns."""
SEEDS = st.integers(0, 3)
OPERATION = st.one_of(
    *[st.tuples(st.just("step"), st.integers(0, 9))] * 4,
    st.tuples(st.just("reset"), SEEDS),
    st.tuples(st.just("reset_some"), st.lists(st.booleans(), min_size=3, max_size=3)),
    *[st.tuples(st.just("set_attr"), st.just(name), value) for name, value in OPTIONS.items()],
    st.just(("read",)),
    st.just(("save",)),
    st.just(("restore",)),
)


def make(task: str) -> gym.Env[Any, Any]:
    return gym.make(task, disable_env_checker=True, max_episode_steps=LIMIT)


HELD = ("_autoreset_envs", "_rewards", "_terminations", "_truncations", "_observations", "_env_obs")
"""Attributes of `SyncVectorEnv` that the next result depends on."""


class Separate(SyncVectorEnv):
    """The truth: one env after the other."""

    def save_state(self) -> Any:
        return [save_state(env) for env in self.envs], {name: vars(self)[name] for name in HELD}

    def load_state(self, state: Any) -> None:
        for env, saved in zip(self.envs, state[0], strict=True):
            load_state(env, saved)
        vars(self).update(state[1])


class Both:
    """Does everything twice, and compares."""

    def __init__(self, task: str, mode: AutoresetMode) -> None:
        with outdated_assets_accepted():
            self.together = MujocoBatch(make(task), NUM_ENVS, mode, num_threads=2)
            self.apart: Any = Separate([lambda: make(task)] * NUM_ENVS, autoreset_mode=mode)
        self.mode = mode
        self.over = np.zeros(NUM_ENVS, np.bool_)
        self.saved: Any = None
        self.reset(0)
        self.save()

    def reset(self, seed: int, options: Any = None) -> None:
        found = self.together.reset(seed=seed, options=options and dict(options))
        assert_alike(found, self.apart.reset(seed=seed, options=options and dict(options)))
        self.over[:] &= False if options is None else ~options["reset_mask"]

    def reset_some(self, chosen: list[bool]) -> None:
        if self.mode == AutoresetMode.DISABLED and any(chosen):
            self.reset(5, {"reset_mask": np.array(chosen)})

    def step(self, seed: int) -> None:
        if self.mode == AutoresetMode.DISABLED and self.over.any():
            self.reset(6, {"reset_mask": self.over.copy()})
        self.together.action_space.seed(seed)
        actions = self.together.action_space.sample()
        found = self.together.step(actions)
        assert_alike(found, self.apart.step(actions))
        self.over = found[2] | found[3]

    def set_attr(self, name: str, value: float) -> None:
        for envs in (self.together, self.apart):
            envs.set_attr(name, value)

    def read(self) -> None:
        for name in ("dt", "init_qpos", "np_random_seed", "_elapsed_steps"):
            assert_alike(self.together.call(name), self.apart.call(name), name)
        for found, expected in zip(
            self.together.call("data"), self.apart.call("data"), strict=True
        ):
            for name in ("qpos", "qvel", "xpos", "cfrc_ext"):
                assert_alike(getattr(found, name), getattr(expected, name), name)

    def save(self) -> None:
        states = self.together.save_state(), self.apart.save_state(), self.over.copy()
        self.saved = pickle.dumps(states)

    def restore(self) -> None:
        together, apart, self.over = pickle.loads(self.saved)
        self.together.load_state(together)
        self.apart.load_state(apart)

    def close(self) -> None:
        self.together.close()
        self.apart.close()


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("task", TASKS)
def test_any_history_equals_that_of_separate_envs(task: str, mode: AutoresetMode) -> None:
    """Steps over ends, resets, options, attributes that are read, snapshots, in any order."""
    both = Both(task, mode)

    @settings(max_examples=NUM_EXAMPLES)
    @given(st.lists(OPERATION, min_size=4, max_size=30))
    def check(operations: list[Any]) -> None:
        for name, value in (("_ctrl_cost_weight", 0.5), ("frame_skip", 5)):
            both.set_attr(name, value)
        both.reset(0)
        both.save()
        for name, *arguments in operations:
            getattr(both, name)(*arguments)
        both.step(0)

    check()
    both.close()
