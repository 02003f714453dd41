"""Envs that are stepped together behind the vector interface: conditions and errors."""

from __future__ import annotations

import copy
import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import (
    AlreadyPendingCallError,
    ResetNeeded,
)
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector.toys import Toy, assert_alike

from rlightning_aio import sync
from rlightning_aio.batch.infos import infos_of_each
from rlightning_aio.envs.mujoco import tasks as mujoco_tasks
from rlightning_aio.errors import ConfigError, EnvRaised, SnapshotError, StartFailed
from rlightning_aio.vector import VectorEnv, make_vec
from rlightning_aio.vector.making import steps_together
from rlightning_aio.vector.mujoco import MujocoVectorEnv

INLINE: dict[str, Any] = {"placement": "inline"}
PENDULUM = "InvertedPendulum-v5"


def test_envs_that_are_stepped_together_need_no_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are one batch in this process, unless MuJoCo has no batches."""
    alone = make_vec(
        PENDULUM, 4, None, {"shared_memory": True}, num_threads=2, autoreset_mode="SameStep"
    )
    assert isinstance(alone, MujocoVectorEnv)
    assert alone.metadata["autoreset_mode"] == alone.autoreset_mode == AutoresetMode.SAME_STEP
    with pytest.raises(AttributeError, match=r"without a group. EnvGroup with EnvConfig"):
        _ = alone.group
    alone.close()
    with pytest.raises(ConfigError, match=r"num_threads needs .* fields of a config entry"):
        make_vec(PENDULUM, 4, vector_kwargs=INLINE, num_threads=2)
    assert steps_together(gym.spec(PENDULUM), {})
    monkeypatch.setattr(mujoco_tasks, "version", lambda _: "3.12.0")
    assert not steps_together(gym.spec(PENDULUM), {})


@pytest.mark.parametrize("fields", [{}, INLINE], ids=["a batch", "separate"])
def test_simulations_that_were_never_reset_make_no_step(fields: dict[str, Any]) -> None:
    """Those that a mask has left out of the first reset are reset by the next one."""
    env = make_vec(PENDULUM, 2, **fields)
    actions = np.zeros((2, 1), np.float32)
    env.reset(seed=3, options={"reset_mask": np.array([True, False])})
    with pytest.raises((ResetNeeded, EnvRaised), match=r"before calling env.reset\(\)"):
        env.step(actions)
    env.close()
    ours, theirs = make_vec(PENDULUM, 2, **fields), make_vec(PENDULUM, 2)
    theirs.reset(seed=3)
    for mask in ([True, False], [False, True]):
        ours.reset(seed=3, options={"reset_mask": np.array(mask)})
    assert_alike(ours.step(actions), theirs.step(actions))
    ours.close()
    theirs.close()


def test_a_mask_that_changes_before_the_resets_are_awaited() -> None:
    """As an array of ends that a program writes to: the first half of the call has a copy."""
    env: Any = make_vec(PENDULUM, 2, autoreset_mode=AutoresetMode.DISABLED, **INLINE)
    before, _ = env.reset(seed=0)
    mask = np.array([True, False])
    env.reset_async(seed=7, options={"reset_mask": mask})
    mask[:] = False, True
    after, _ = env.reset_wait()
    assert (after != before).any(axis=1).tolist() == [True, False]
    env.close()


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("task", ["Hopper-v5", "Reacher-v5"])
@pytest.mark.parametrize("fields", [{}, INLINE], ids=["a batch", "separate"])
def test_a_state_can_be_restored_again(
    task: str, mode: AutoresetMode, fields: dict[str, Any]
) -> None:
    """Also after more steps, and in another one; what was returned doesn't change."""
    fields = {"autoreset_mode": mode, "max_episode_steps": 6, **fields}
    one, other = (make_vec(task, 3, **fields) for _ in range(2))
    one.reset(seed=1)
    one.action_space.seed(0)
    actions = [one.action_space.sample() for _ in range(9)]
    one.step(actions[0])
    kept = one.snapshot()

    def steps(env: Any) -> list[Any]:
        found = [env.step(each) for each in actions[1:5]]
        found.append(env.reset(options={"reset_mask": np.array([True, False, True])}))
        return [*found, *(env.step(each) for each in actions[5:])]

    found = steps(one)
    copies = copy.deepcopy(found)
    for env in (one, one, other):
        env.restore(kept)
        assert_alike(steps(env), copies)
    assert_alike(found, copies)
    one.close()
    other.close()


OTHERS: dict[str, Any] = {
    "num_envs": {"num_envs": 3},
    "mode": {"autoreset_mode": "SameStep"},
    "limit": {"max_episode_steps": 7},
    "kind": {"vector_kwargs": INLINE},
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_batch_refuses_the_state_of_another_one(other: str) -> None:
    """And goes on as if nothing had been."""
    fields = {"num_envs": 2, "autoreset_mode": "NextStep", "max_episode_steps": 3}
    theirs = make_vec(PENDULUM, **fields | OTHERS[other])
    ours, alike = make_vec(PENDULUM, **fields), make_vec(PENDULUM, **fields)
    for env in (theirs, ours, alike):
        env.reset(seed=0)
    with pytest.raises(SnapshotError, match=r"into a MujocoVectorEnv.*nothing was changed"):
        ours.restore(theirs.snapshot())
    with pytest.raises(SnapshotError):
        theirs.restore(ours.snapshot())
    actions = np.zeros((2, 1), np.float32)
    for _ in range(5):
        assert_alike(ours.step(actions), alike.step(actions))
    assert_alike(ours.reset(seed=5), alike.reset(seed=5))
    for env in (theirs, ours, alike):
        env.close()


def test_nothing_is_saved_before_a_reset_or_while_a_step_is_pending() -> None:
    for env in (make_vec(PENDULUM, 2), make_vec(PENDULUM, 2, vector_kwargs=INLINE)):
        with pytest.raises((ResetNeeded, SnapshotError)):
            env.snapshot()
        env.reset(seed=0)
        state = env.snapshot()
        if isinstance(env, VectorEnv):
            env.step_async(np.zeros((2, 1), np.float32))
            with pytest.raises(AlreadyPendingCallError):
                env.snapshot()
            with pytest.raises(AlreadyPendingCallError):
                env.restore(state)
            env.step_wait()
        env.close()


def test_what_is_restored_is_returned_as_by_a_reset() -> None:
    """The observations that were returned last, in arrays of one's own."""
    envs: Any = make_vec("Hopper-v5", 2)
    envs.reset(seed=0)
    shown = envs.step(envs.action_space.sample())[0]
    snapshot = envs.snapshot()
    envs.reset(seed=5)
    observations, infos = envs.restore(snapshot)
    np.testing.assert_array_equal(observations, shown)
    assert infos == {}
    with pytest.raises(SnapshotError, match=r"checksum doesn't match.*nothing was changed"):
        envs.restore(snapshot[:-1] + b"?")
    observations[:] = 0.0
    np.testing.assert_array_equal(envs.restore(snapshot)[0], shown)
    envs.close()


def test_attributes_that_would_make_them_differ_raise() -> None:
    """Attributes of some envs, and attributes of each env; the error says what to do."""
    env = make_vec(PENDULUM, 3)
    env.reset(seed=0)
    for name, values in (("frame_skip", [1, 2, 3]), ("model", 1), ("data", 1)):
        with pytest.raises(ValueError, match=r"make separate envs \(vectorization_mode='async'\)"):
            env.set_attr(name, values)
    env.set_attr("frame_skip", [3, 3, 3])
    assert env.get_attr("frame_skip") == (3, 3, 3)
    env.step(env.action_space.sample())
    env.close()


@pytest.mark.parametrize("count", [1, 2])
def test_a_callable_that_returns_a_vector_environment_raises(count: int) -> None:
    make = functools.partial(SyncVectorEnv, [Toy] * count)
    with pytest.raises(StartFailed, match=r"must return one env, not a SyncVectorEnv: use that"):
        VectorEnv([make] * 2, **INLINE)


def test_an_entry_of_vector_environments_of_one_is_refused() -> None:
    """They would have an axis that no single env has."""
    config: Any = {"name": "e", "task": functools.partial(SyncVectorEnv, [Toy]), **INLINE}
    with pytest.raises(ConfigError, match="a SyncVectorEnv of one env; return that env itself"):
        sync.build_env_group(config).init()


@pytest.mark.parametrize(
    ("words", "expected"),
    [(["a", "b"], ["a", "b"]), (["a"], [["a"]] * 2), (("a", "b", "c"), [("a", "b", "c")] * 2)],
)
def test_a_list_in_infos_is_of_each_env_if_it_has_as_many_values(
    words: Any, expected: list[Any]
) -> None:
    infos = infos_of_each({"own": {"words": words}}, 2)["own"]
    assert infos["words"].tolist() == expected
    assert infos["_words"].all()
