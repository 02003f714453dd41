"""Many MuJoCo simulations in one env are bit-identical to separate Gymnasium envs."""

from __future__ import annotations

import ctypes
import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from vector.toys import assert_alike

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.mujoco import threads as mujoco_threads
from rlightning_aio.envs.mujoco.batch import MujocoBatch
from rlightning_aio.envs.mujoco.outputs import compiled, offset_of
from rlightning_aio.envs.mujoco.threads import Simulations
from rlightning_aio.envs.simulators.gymnasium import MujocoEnv, outdated_assets_accepted
from rlightning_aio.errors import ConfigError
from rlightning_aio.vector import make_vec

if TYPE_CHECKING:
    from collections.abc import Callable

mujoco: Any = import_module("mujoco")

WEIGHT = st.floats(0.001, 3) | st.integers(1, 3)
NOISE = st.floats(0, 0.3)
RANGE = st.tuples(st.floats(-2, 0.9), st.floats(1, 3))
WALK = {
    "forward_reward_weight": WEIGHT,
    "ctrl_cost_weight": WEIGHT,
    "reset_noise_scale": NOISE,
    "exclude_current_positions_from_observation": st.booleans(),
}
HEALTH = {
    "healthy_reward": WEIGHT,
    "terminate_when_unhealthy": st.booleans(),
    "healthy_z_range": RANGE,
}
PARTS = {
    f"include_{part}_in_observation": st.booleans()
    for part in ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
}
REACH = {"reward_dist_weight": WEIGHT, "reward_control_weight": WEIGHT}
TASKS: dict[str, dict[str, Any]] = {
    "Ant-v5": WALK
    | HEALTH
    | {
        "contact_cost_weight": WEIGHT,
        "contact_force_range": RANGE,
        "main_body": st.sampled_from([1, "torso"]),
        "include_cfrc_ext_in_observation": st.booleans(),
    },
    "HalfCheetah-v5": WALK | {"frame_skip": st.just(5)},
    "Hopper-v5": WALK | HEALTH | {"healthy_state_range": RANGE, "healthy_angle_range": RANGE},
    "Humanoid-v5": WALK
    | HEALTH
    | PARTS
    | {"contact_cost_weight": WEIGHT, "contact_cost_range": RANGE},
    "HumanoidStandup-v5": PARTS
    | {
        "uph_cost_weight": WEIGHT,
        "ctrl_cost_weight": WEIGHT,
        "impact_cost_weight": WEIGHT,
        "impact_cost_range": RANGE,
        "reset_noise_scale": NOISE,
        "exclude_current_positions_from_observation": st.booleans(),
    },
    "InvertedDoublePendulum-v5": {"healthy_reward": WEIGHT, "reset_noise_scale": NOISE},
    "InvertedPendulum-v5": {"reset_noise_scale": NOISE},
    "Pusher-v5": REACH | {"reward_near_weight": WEIGHT},
    "Reacher-v5": REACH,
    "Swimmer-v5": WALK,
    "Walker2d-v5": WALK | HEALTH | {"healthy_angle_range": RANGE},
}
OPTIONS = {
    task: st.fixed_dictionaries({}, optional=fields | {"max_episode_steps": st.integers(3, 60)})
    for task, fields in TASKS.items()
}


def make(task: str, options: dict[str, Any]) -> Callable[[], gym.Env[Any, Any]]:
    return lambda: gym.make(task, disable_env_checker=True, **options)


def compare(
    task: str, options: dict[str, Any], seed: int, num_steps: int, num_threads: int = 2
) -> None:
    """Observations, rewards, ends, infos and their dtypes, over ends; the seeds differ."""
    with outdated_assets_accepted():
        ours = MujocoBatch(make(task, options)(), 3, num_threads=num_threads)
        theirs: Any = SyncVectorEnv([make(task, options)] * 3)
    seeds = [seed, seed + 10, seed + 5]
    assert_alike(ours.reset(seed=seeds), theirs.reset(seed=seeds))
    actions = np.random.default_rng(seed)
    low, high = ours.action_space.low, ours.action_space.high  # pyright: ignore[reportAttributeAccessIssue]
    for step in range(num_steps):
        # Also beyond the bounds, where MuJoCo clips.
        action = (1.2 * actions.uniform(low, high)).astype(np.float32)
        assert_alike(ours.step(action), theirs.step(action), f"{task} {options}, step {step}")
    ours.close()
    theirs.close()


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("task", TASKS)
def test_every_task_equals_gymnasiums(task: str) -> None:
    """Without options, and with short episodes; with any number of threads."""
    compare(task, {}, 1, 30)
    compare(task, {"max_episode_steps": 4}, 2, 12, num_threads=1)
    compare(task, {"max_episode_steps": 4}, 2, 12, num_threads=3)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("task", TASKS)
def test_options_have_the_same_effect_as_in_gymnasium(task: str) -> None:
    """All arguments of the constructor of a task."""

    @settings(max_examples=settings.default.max_examples // 6)
    @given(OPTIONS[task], st.integers(0, 1000))
    def check(options: dict[str, Any], seed: int) -> None:
        compare(task, options, seed, 15)

    check()


def test_contact_forces_are_compiled_where_the_kernel_is(implementation: str) -> None:
    """So the tests of both implementations compare two ways to contact forces."""
    assert (compiled() is None) == (implementation == "python")


def test_a_field_that_is_elsewhere_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset of a field is MuJoCo's own word, but it is checked with real data."""
    env: Any = make("HalfCheetah-v5", {})().unwrapped
    for name in ("qpos", "qvel", "ctrl", "cfrc_ext", "xipos", "ten_length"):
        assert offset_of(name, env.data) > 0

    class Moved(ctypes.Structure):
        _fields_ = (("time", ctypes.c_double), ("qpos", ctypes.c_void_p))

    monkeypatch.setattr("rlightning_aio.envs.mujoco.outputs._struct", lambda _: Moved)
    with pytest.raises(RuntimeError, match=r"mjData\.qpos is not where"):
        offset_of("qpos", env.data)
    env.close()


def test_returned_arrays_are_used_again_when_nobody_has_them() -> None:
    """Whoever holds one, or a view of it, keeps its values."""
    batch = MujocoBatch(make("HalfCheetah-v5", {})(), 2)
    batch.reset(seed=0)
    kept: list[tuple[Any, Any]] = []
    actions = np.zeros((2, 6), np.float32)
    for k in range(40):
        observations, rewards, _, _, infos = batch.step(actions)
        if k % 3 == 0:
            kept.append((observations[:, 1:][::-1], observations.copy()))
            kept.append((rewards, rewards.copy()))
            kept.append((infos["x_position"][1:], infos["x_position"][1:].copy()))
        del observations, infos
    for values, copy in kept[1::3] + kept[2::3]:
        np.testing.assert_array_equal(values, copy)
    for values, copy in kept[::3]:
        np.testing.assert_array_equal(values[::-1], copy[:, 1:])
    batch.close()


SMALL = "a simulation that runs out of memory"
"""MuJoCo raises an error for it when it has several contacts."""
WILD = "a simulation that moves too fast"
"""MuJoCo warns, and resets it to the defaults of the model."""


def ants(reason: str, mode: AutoresetMode, folder: Path) -> MujocoBatch:
    """Two Ants; the second will fail."""
    options: dict[str, Any] = {}
    if reason == SMALL:
        assets = Path(gym.__file__).parent / "envs" / "mujoco" / "assets"
        text = (assets / "ant.xml").read_text()
        (folder / "ant.xml").write_text(text.replace("<option", '<size memory="14K"/><option', 1))
        options["xml_file"] = str(folder / "ant.xml")
    return MujocoBatch(make("Ant-v5", options)(), 2, mode, num_threads=2)


def move(batch: MujocoBatch, k: int, positions: Any, velocities: Any) -> None:
    """Put simulation `k` elsewhere, by its state, which begins with time, positions, velocities."""
    state = batch.save_state()
    moving = np.concatenate([positions, velocities])
    state["simulations"][0][k, 1 : 1 + len(moving)] = moving
    batch.load_state(state)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("reason", [SMALL, WILD])
def test_a_simulation_that_fails_ends_its_own_episode(
    reason: str, mode: AutoresetMode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is truncated, with the cause and its last observation; the other one is unaffected."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs there.
    batch = ants(reason, mode, tmp_path)
    alone: Any = make("Ant-v5", {})()
    before, _ = batch.reset(seed=[0, 1])
    alone.reset(seed=0)
    actions = np.random.default_rng(1).uniform(-1, 1, (200, 2, 8)).astype(np.float32)
    actions[:, 0] = 0.0  # It stands, and never touches the ground with more than its feet.
    if reason == WILD:
        data = batch.call_one(1, "data")
        move(batch, 1, data.qpos, data.qvel + 1e9)
    for action in actions:
        observations, rewards, terminated, truncated, infos = batch.step(action)
        expected = alone.step(action[0])
        np.testing.assert_array_equal(observations[0], expected[0])
        assert (rewards[0], terminated[0], truncated[0]) == expected[1:4]
        if truncated[1]:
            break
        before = observations
    else:
        pytest.fail("no simulation has failed")
    if mode == AutoresetMode.SAME_STEP:
        last, info = infos["final_obs"][1], infos["final_info"]
        assert (observations[1] != last).any()
    else:
        last, info = observations[1], infos
    if reason == SMALL:
        np.testing.assert_array_equal(last, before[1])
    assert (rewards[1], terminated[1]) == (0.0, False)
    assert ("out of memory" if reason == SMALL else "is unstable") in info["simulation_failed"][1]
    assert info["_simulation_failed"].tolist() == [False, True]
    if mode == AutoresetMode.NEXT_STEP:
        _, _, _, truncated, infos = batch.step(actions[0])
        assert not truncated.any()
        assert "simulation_failed" not in infos
        assert infos["_x_position"].all()
    batch.close()
    alone.close()


def test_methods_of_single_simulations_cannot_be_called() -> None:
    """Their attributes can be read, also by Gymnasium's own accessors."""
    batch = MujocoBatch(make("Hopper-v5", {})(), 2)
    batch.reset(seed=0)
    for name, arguments in (("set_state", (1, 2)), ("get_wrapper_attr", ("step",)), ("close", ())):
        with pytest.raises(NotImplementedError, match=f"{name}.*vectorization_mode='async'"):
            batch.call(name, *arguments)
    data = batch.call("data")[1]
    data.qpos[:] = 5.0  # A copy.
    assert (batch.call_one(1, "data").qpos != data.qpos).all()
    assert batch.call("dt") == batch.call("get_wrapper_attr", "dt") == (0.008, 0.008)
    assert batch.call("has_wrapper_attr", "nothing") == (False, False)
    with pytest.raises(AttributeError, match="nothing"):
        batch.call("nothing")
    batch.close()


@pytest.mark.parametrize("values", [[], (3,), [3, 3, 3]])
def test_an_attribute_needs_one_value_for_each_simulation(values: Any) -> None:
    batch = MujocoBatch(make("Hopper-v5", {})(), 2)
    with pytest.raises(ValueError, match=f"{len(values)} values for num_envs=2"):
        batch.set_attr("frame_skip", values)
    batch.close()


def test_a_failure_and_an_end_in_one_step_have_infos_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With `AutoresetMode.SAME_STEP`: a cause for the one that failed, a reward for the other."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs there.
    batch = MujocoBatch(make("Hopper-v5", {})(), 3, AutoresetMode.SAME_STEP)
    batch.reset(seed=0)
    lying, still = batch.env.init_qpos.copy(), batch.env.init_qvel
    lying[1] = 0.3
    move(batch, 0, batch.env.init_qpos, still + 1e11)
    move(batch, 1, lying, still)
    _, _, terminated, truncated, infos = batch.step(np.zeros((3, 3), np.float32))
    assert (terminated.tolist(), truncated.tolist()) == ([False, True, False], [True, False, False])
    last = infos["final_info"]
    assert last["_simulation_failed"].tolist() == [True, False, False]
    assert last["simulation_failed"].tolist()[1:] == [None, None]
    assert last["_x_position"].tolist() == [False, True, False]
    assert infos["_x_position"].all()
    assert "simulation_failed" not in infos
    batch.close()


def test_threads_are_only_those_of_envs_that_are_stepped_together() -> None:
    """The error says what separates them."""
    with pytest.raises(ConfigError, match="num_threads needs envs that are stepped"):
        make_vec("Hopper-v5", 2, "async", num_threads=2)


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_a_group_of_batches_equals_separate_envs(placement: str) -> None:
    """Two envs of three each, with consecutive seeds and autoreset."""
    fields = {"max_episode_steps": 6, "env_kwargs": {"reset_noise_scale": 0.2}}
    entry = {"name": "hop", "backend": "mujoco", "task": "Hopper-v5", "num_envs": 3, **fields}
    plain = SyncVectorEnv(
        [make("Hopper-v5", {"max_episode_steps": 6, "reset_noise_scale": 0.2})] * 6
    )
    with sync.build_env_group({**entry, "num_workers": 2, "placement": placement}) as group:
        (meta, _) = group.init()
        assert (meta.num_envs, meta.autoreset, meta.max_episode_steps) == (3, "next_step", 6)
        batch, _ = group.reset(seed=7)
        observation, infos = plain.reset(seed=7)
        actions = np.random.default_rng(0).uniform(-1, 1, (20, 6, 3)).astype(np.float32)
        for action in actions:
            assert_alike(batch.observation, observation.reshape(2, 3, -1))
            for name, column in infos.items():
                assert_alike(batch.infos[name], column.reshape(2, 3))
            batch, _ = group.step(batch.respond(action=action.reshape(2, 3, 3)))
            observation, rewards, terminated, truncated, infos = plain.step(action)
            assert_alike(batch.reward, rewards.reshape(2, 3))
            assert_alike(batch.terminated, terminated.reshape(2, 3))
            assert_alike(batch.truncated, truncated.reshape(2, 3))
    plain.close()


@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
def test_tasks_that_cannot_be_batched_are_stepped_in_a_loop_with_a_warning() -> None:
    """Older versions, and wrapped tasks."""
    config = EnvConfig(name="old", backend="mujoco", task="Hopper-v4", num_envs=2)
    with pytest.warns(RuntimeWarning, match=r"one after the other: HopperEnv is not one of"):
        env = MujocoEnv(config)
    assert env.reset(seed=0).observation.shape == (2, 11)
    env.close()
    checked = config.model_copy(
        update={"task": "Hopper-v5", "env_kwargs": {"disable_env_checker": False}}
    )
    with pytest.warns(RuntimeWarning, match="wrapped in PassiveEnvChecker"):
        MujocoEnv(checked).close()


def test_an_older_mujoco_steps_them_in_a_loop_with_a_warning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its library lacks the functions, as the one of this process's own symbols does."""
    own = ctypes.CDLL(None)
    monkeypatch.setattr(mujoco_threads.ctypes, "CDLL", lambda _: own)
    mujoco_threads._library.cache_clear()  # pyright: ignore[reportPrivateUsage]
    config = EnvConfig(name="old", backend="mujoco", task="Hopper-v5", num_envs=2)
    with pytest.warns(RuntimeWarning, match=r"has no batches; install mujoco 3\.17 or later"):
        env = MujocoEnv(config)
    assert env.reset(seed=0).observation.shape == (2, 11)
    env.close()


def test_misuse_is_refused() -> None:
    """A step before the first reset, a wrong shape of actions, a wrong number of seeds."""
    batch = MujocoBatch(make("InvertedPendulum-v5", {})(), 2)
    with pytest.raises(gym.error.ResetNeeded):
        batch.step(np.zeros((2, 1), np.float32))
    with pytest.raises(ValueError, match="1 seeds for num_envs=2"):
        batch.reset(seed=[1])
    batch.reset()
    with pytest.raises(ValueError, match=r"shape \(2, 1\), not \(2,\)"):
        batch.step(np.zeros(2, np.float32))
    batch.close()
    config = EnvConfig(
        name="x", backend="mujoco", task="Hopper-v5", num_envs=2, env_kwargs={"num_threads": 0}
    )
    for start in (lambda: MujocoEnv(config), lambda: make_vec("Hopper-v5", 2, num_threads=0)):
        with pytest.raises(ConfigError, match=r"num_threads is 0, but must be an int above"):
            start()


def test_one_of_them_is_rendered() -> None:
    """Like the Gymnasium env with that seed."""
    if os.environ.get("MUJOCO_GL") not in ("egl", "osmesa", "glfw"):
        pytest.skip("needs MUJOCO_GL")
    look = {"render_mode": "rgb_array", "width": 64, "height": 64}
    batch, alone = MujocoBatch(make("Hopper-v5", look)(), 2), make("Hopper-v5", look)()
    batch.reset(seed=3)
    alone.reset(seed=4)
    action = np.ones((2, 3), np.float32)
    for _ in range(5):
        batch.step(action)
        alone.step(action[0])
    np.testing.assert_array_equal(batch.render()[1], alone.render())
    assert (batch.render_one(0) != batch.render_one(1)).any()
    batch.close()
    alone.close()


@pytest.mark.parametrize(
    ("placement", "num_workers", "num_threads"),
    [("inline", 1, 4), ("inline", 2, 4), ("process", 2, 2), ("process", 8, 1)],
)
def test_batches_of_one_entry_share_the_cores(
    placement: str, num_workers: int, num_threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers compute at the same time; inline, one batch is stepped after the other."""
    asked: list[int] = []

    class Counted(Simulations):
        def __init__(self, model: Any, count: int, num_threads: int, **options: Any) -> None:
            asked.append(num_threads)
            super().__init__(model, count, num_threads, **options)

    monkeypatch.setattr("rlightning_aio.envs.mujoco.batch.Simulations", Counted)
    monkeypatch.setattr("rlightning_aio.envs.simulators.gymnasium.num_cores", lambda: 4)
    config = EnvConfig.model_validate(
        {
            "name": "x", "backend": "mujoco", "task": "Hopper-v5", "num_envs": 2,
            "placement": placement, "num_workers": num_workers,
        }
    )  # fmt: skip
    MujocoEnv(config).close()
    assert asked == [num_threads]
