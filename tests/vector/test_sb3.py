"""Compares the adapter with Stable-Baselines3's own vector env, and trains on it."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from kit.scripted import DIE, RAISE, Counts, Scripted
from vector.toys import assert_alike

from rlightning_aio.vector import make_vec

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.simulators


@pytest.fixture(autouse=True)
def stable_baselines3() -> Any:
    return pytest.importorskip("stable_baselines3")


def test_after_an_env_has_raised_all_are_reset() -> None:
    """In a step, or in the reset of the one whose options say so."""
    from rlightning_aio.errors import EnvRaised
    from rlightning_aio.sb3 import VecEnv

    env = VecEnv([Scripted] * 3, envs_per_process=3)
    env.set_options([{}, {"deed": RAISE}, {}])
    with pytest.raises(EnvRaised, match="env-1"):
        env.reset()
    env.set_options()
    env.reset()
    with pytest.raises(EnvRaised, match="as asked"):
        env.step([RAISE, 0, RAISE])
    with pytest.raises(ResetNeeded, match="set_env"):
        env.step([0, 0, 0])
    assert env.reset().tolist() == [[0], [0], [0]]
    assert env.step([0, 0, 0])[0].tolist() == [[1], [1], [1]]
    env.close()


@pytest.mark.parametrize("kind", ["sync", "group"])
def test_a_method_of_some_envs_leaves_the_others_alone(kind: str) -> None:
    from rlightning_aio.sb3 import VecEnv

    env = VecEnv(hoppers(kind))
    env.seed(0)
    env.reset()
    before = env.env_method("state_vector")
    state = np.arange(6) / 10
    assert env.env_method("set_state", state, -state, indices=[1]) == [None]
    after = env.env_method("state_vector")
    same = [np.array_equal(one, other) for one, other in zip(before, after, strict=True)]
    assert same == [True, False, True]
    np.testing.assert_array_equal(after[1], [*state, *-state])
    env.env_method("set_wrapper_attr", name="note", value=[1, 2])
    assert env.get_attr("note", indices=[2]) == [[1, 2]]
    env.close()


class Pushed(Counts):
    """Its action is a tree."""

    observation_space = gym.spaces.Box(-9, 9, (2,), np.float64)
    action_space = gym.spaces.Dict(
        push=gym.spaces.Box(-1, 1, (2,), np.float64), times=gym.spaces.Discrete(5)
    )
    at = np.zeros(2)

    def does(self, action: Any) -> None:
        self.at = action["push"] * action["times"]

    def observed(self) -> Any:
        return self.at


@pytest.mark.parametrize("together", [False, True])
def test_actions_may_be_trees(together: bool) -> None:
    """One for each env, as in Stable-Baselines3, also for envs of a vector env."""
    from rlightning_aio.sb3 import VecEnv

    mode = AutoresetMode.SAME_STEP
    makers = [Pushed] * 4
    envs = VecEnv(gym.vector.SyncVectorEnv(makers, autoreset_mode=mode) if together else makers)
    envs.reset()
    actions = [{"push": np.array([0.5, k / 4]), "times": k} for k in range(4)]
    found = envs.step(actions)[0]
    assert found.tolist() == [(one["push"] * one["times"]).tolist() for one in actions]
    with pytest.raises(ValueError, match="3 actions"):
        envs.step(actions[:3])
    envs.close()


def short_hopper() -> gym.Env[Any, Any]:
    return gym.make("Hopper-v5", max_episode_steps=15, disable_env_checker=True)


def hoppers(kind: str) -> Any:
    mode = AutoresetMode.SAME_STEP
    if kind == "together":
        return make_vec("Hopper-v5", 3, autoreset_mode=mode, max_episode_steps=15)
    if kind == "group":
        return make_vec("Hopper-v5", 3, "async", autoreset_mode=mode, max_episode_steps=15)
    if kind == "sync":
        return gym.vector.SyncVectorEnv([short_hopper] * 3, autoreset_mode=mode)
    # Without shared memory, of which Gymnasium leaves descriptors behind.
    return gym.vector.AsyncVectorEnv([short_hopper] * 3, shared_memory=False, autoreset_mode=mode)


@pytest.mark.parametrize("kind", ["together", "group", "sync", "async"])
def test_any_vector_env_does_the_same_as_dummy_vec_env(kind: str) -> None:
    """Observations, rewards, dones, infos, infos of resets, seeds, calls of some, attributes."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    from rlightning_aio.sb3 import VecEnv

    ours, theirs = VecEnv(hoppers(kind)), DummyVecEnv([short_hopper] * 3)
    assert isinstance(ours, VecEnv)
    for env in (ours, theirs):
        env.seed(5)
    assert_alike(ours.reset(), theirs.reset())
    draws = np.random.default_rng(0)
    for turn in range(60):
        actions = draws.uniform(-1, 1, (3, 3)).astype(np.float32)
        found, expected = ours.step(actions), theirs.step(actions)
        assert_alike(found[0], expected[0], f"{turn}")
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-6)
        assert_alike(found[2], expected[2])
        for each, other in ((list(found[3]), expected[3]), (ours.reset_infos, theirs.reset_infos)):
            assert len(each) == len(other)
            for info, plain in zip(each, other, strict=True):
                assert info.keys() == plain.keys(), f"{turn}"
                for key, value in plain.items():
                    np.testing.assert_array_equal(info[key], value, key)
    assert ours.get_attr("dt") == theirs.get_attr("dt")
    assert ours.has_attr("frame_skip")
    assert not ours.has_attr("nothing")
    # An AsyncVectorEnv can't be asked.
    assert ours.env_is_wrapped(gym.wrappers.TimeLimit) == [kind != "async"] * 3
    assert ours.get_attr("np_random_seed", indices=[2, -3]) == [7, 5]
    if kind in ("together", "async"):
        with pytest.raises(ValueError, match=r"VectorEnv can't call .* of only some of its envs"):
            ours.env_method("get_wrapper_attr", "dt", indices=[1])
    ours.set_attr("frame_skip", 2)
    assert ours.get_attr("frame_skip") == [2, 2, 2]
    ours.close()
    theirs.close()


def test_a_vector_env_in_another_mode_is_refused() -> None:
    """As are fields of an entry, and a group is asked for."""
    from rlightning_aio.errors import ConfigError
    from rlightning_aio.sb3 import VecEnv, make_vec_env

    pole = gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")])
    with pytest.raises(ConfigError, match=r"NEXT_STEP; Stable-Baselines3 needs"):
        VecEnv(pole)
    envs: Any = make_vec_env("Hopper-v5", 4)
    with pytest.raises(AttributeError, match="without a group"):
        _ = envs.venv.group
    with pytest.raises(ConfigError, match=r"^task: the envs are those of the callables"):
        VecEnv([lambda: gym.make("CartPole-v1")], task="Acrobot-v1")
    with pytest.raises(ConfigError, match="step_timeout: a vector env has no workers"):
        VecEnv(envs.venv.envs, step_timeout=3.0)
    with pytest.raises(ValueError, match="MujocoVectorEnv can't set frame_skip of only"):
        envs.set_attr("frame_skip", 2, indices=[1])
    envs.set_options([{"a": 1}, {}, {}, {}])
    with pytest.raises(ValueError, match="options of envs differ, and a MujocoVectorEnv resets"):
        envs.reset()
    envs.close()
    pole.close()


class Bare(gym.vector.VectorEnv[Any, Any, Any]):
    """Counts to 2 and back; its infos have no masks and no final_info, and it has no `call`."""

    metadata: ClassVar = {"autoreset_mode": AutoresetMode.SAME_STEP}
    num_envs = 2
    single_observation_space = gym.spaces.Box(0, 2, (1,), np.int64)
    single_action_space = gym.spaces.Discrete(2)
    tells = True

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.counts = np.array([[0], [1]])
        return self.counts.copy(), {"count": self.counts[:, 0].copy()}

    def step(self, actions: Any) -> Any:
        self.counts += 1
        last, done = self.counts.copy(), self.counts[:, 0] == 2
        self.counts[done] = 0
        infos = {"count": self.counts[:, 0].copy()}
        if done.any() and self.tells:
            infos["final_obs"] = last
        return self.counts.copy(), np.ones(2), done, np.zeros(2, np.bool_), infos


def test_a_vector_env_without_masks_and_without_final_info() -> None:
    """Nor a way to ask its envs. Without last observations it is no use."""
    from rlightning_aio.sb3 import VecEnv

    envs = Bare()
    env = VecEnv(envs)
    assert env.render_mode is None
    assert env.get_attr("tells", indices=[0]) == [True]
    assert (env.has_attr("tells"), env.has_attr("nothing")) == (True, False)
    with pytest.raises(NotImplementedError, match=r"a Bare can't call render\(\) of its envs"):
        env.env_method("render")
    assert env.reset().tolist() == [[0], [1]]
    assert env.reset_infos == [{"count": 0}, {"count": 1}]
    observation, _, done, infos = env.step([0, 0])
    assert observation.tolist() == [[1], [0]]
    assert done.tolist() == [False, True]
    assert infos[0] == {"count": 1, "TimeLimit.truncated": False}
    assert infos[1].pop("terminal_observation").tolist() == [2]
    assert infos[1] == {"TimeLimit.truncated": False}
    assert env.reset_infos == [{"count": 0}, {"count": 0}]
    envs.tells = False
    with pytest.raises(ValueError, match="Bare has ended an episode without final_obs"):
        env.step([0, 0])


class SameNames(gym.Env[Any, Any]):
    """Its infos have keys that this library, Gymnasium and Stable-Baselines3 use as well."""

    observation_space = gym.spaces.Box(0, 9, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {**self.own, "worker_restarted": "by me", "episode": 3}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return np.full(1, self.steps, np.float32), 1.0, self.steps == 2, False, {**self.own}

    own: ClassVar = {
        "TimeLimit.truncated": "mine",
        "outcome": "open",
        "suspects": [1],
        "terminal_observation": 5,
        "is_success": True,
    }


@pytest.mark.parametrize("fields", [{}, {"placement": "inline"}])
def test_names_of_an_env_that_are_ours_as_well_are_its_own(fields: dict[str, Any]) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    from rlightning_aio.sb3 import VecEnv

    ours, theirs = VecEnv([SameNames] * 2, **fields), DummyVecEnv([SameNames] * 2)
    for step in range(5):
        for env in (ours, theirs) if not step else ():
            env.reset()
        assert_alike(ours.reset_infos, theirs.reset_infos)
        assert_alike(list(ours.step([0, 0])[3]), theirs.step([0, 0])[3])
    assert ours.reset_infos[1]["TimeLimit.truncated"] == "mine"
    ours.close()


class Short(Scripted):
    """Its episodes have two steps."""

    length = 2


def test_a_monitor_continues_its_file_after_a_restart(tmp_path: Path) -> None:
    """And begins it anew in another program, as Stable-Baselines3 does, unless it must not."""
    from rlightning_aio.sb3 import make_vec_env

    def lines() -> list[str]:
        return (tmp_path / "0.monitor.csv").read_text().splitlines()

    for kwargs in ({}, {"override_existing": False}):
        before = len(lines()) if kwargs else 2
        given = {"monitor_dir": str(tmp_path), "monitor_kwargs": kwargs}
        env = make_vec_env(Short, 2, vec_env_kwargs={"on_env_error": "restart"}, **given)
        env.reset()
        for action in (0, 0, DIE, 0, 0, RAISE, 0, 0):
            env.step([action, 0])
        env.close()
        assert len(lines()) == before + 3
        assert [line[:2] for line in lines() if not line[0].isdigit()] == ["#{", "r,"]


class Locked(Counts):
    """Has an attribute that can't be pickled."""

    metadata: ClassVar = {"render_modes": [], "render_fps": 7}

    def __init__(self) -> None:
        self.lock = threading.Lock()

    def masks(self) -> list[int]:
        return [0, 1]


def test_has_attr_does_not_transfer_the_value() -> None:
    """As in look-ups of a mask method; films have the frame rate of the envs."""
    from rlightning_aio.sb3 import VecEnv

    env = VecEnv([Locked] * 2)
    assert env.has_attr("lock")
    assert env.has_attr("masks")
    assert not env.has_attr("nothing")
    assert env.metadata["render_fps"] == 7
    env.close()


class Asked(Counts):
    """Counts the calls of its method."""

    asked = 0

    def ask(self) -> str:
        self.asked += 1
        return "yes"


def test_an_env_with_two_indices_is_called_twice() -> None:
    from rlightning_aio.sb3 import VecEnv

    env = VecEnv([Asked] * 3)
    assert env.env_method("ask", indices=[1, 1, 0, -2]) == ["yes"] * 4
    assert env.get_attr("asked") == [1, 3, 0]
    env.set_attr("asked", 7, indices=[2, 2])
    assert env.get_attr("asked", indices=[2, 2, 0]) == [7, 7, 1]
    env.close()
