"""Worker deaths behind the vector interfaces look like truncated episodes."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers
from kit.processes import kill, stop
from vector.toys import Counted, Mortal, assert_alike

from rlightning_aio.errors import WorkerDied
from rlightning_aio.vector import VectorEnv, make_vec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TASK, ACTIONS = "Hopper-v5", np.full((4, 3), 0.1, np.float32)
MODES = list(AutoresetMode)
LOST = [True, True, False, False]


def made(**arguments: Any) -> VectorEnv:
    """Two workers, each with two envs."""
    entry = {"placement": "process", "envs_per_process": 2, **arguments}
    envs = make_vec(TASK, 4, vector_kwargs=entry)
    assert isinstance(envs, VectorEnv)
    return envs


def killed(group: Any, send: Callable[[], None]) -> None:
    """Kill the first worker before it executes what `send` sends."""
    pid = group.get_workers()[0]["pid"]
    stop(pid)
    send()
    kill(pid)


@pytest.fixture
def twins() -> Iterator[Any]:
    """An action for each env."""
    envs: Any = gym.make_vec(TASK, 4, "sync")
    envs.reset(seed=7)
    yield envs
    envs.close()


def mortals(mode: AutoresetMode, *, dies: bool, **entry: Any) -> Any:
    """Three envs, each in a worker of its own, or in this process if they don't die."""
    makers = [lambda k=k: Mortal(k, dies=dies) for k in range(3)]
    if not dies:
        return gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
    return VectorEnv(makers, autoreset_mode=mode, envs_per_process=1, max_restarts=9, **entry)


def raising(mode: AutoresetMode, place: dict[str, Any]) -> Any:
    """Three envs that raise where `mortals` die."""
    makers = [lambda k=k: Mortal(k, dies=True, raises=True) for k in range(3)]
    fields: dict[str, Any] = {"on_env_error": "restart", "max_restarts": 9, **place}
    return VectorEnv(makers, autoreset_mode=mode, **fields)


def plainly(stepped: Any, mode: AutoresetMode) -> Any:
    """Results without causes of deaths and without times."""
    infos = stepped[-1]
    for found in (infos, infos.get("final_info", {})):
        if "env_at_fault" in found:
            mask, at_fault = found.pop("_env_at_fault"), found.pop("env_at_fault")
            assert [at_fault[k] for k in np.flatnonzero(mask)] == [
                f"env-{k}" for k in np.flatnonzero(mask)
            ]
        if "outcome" in found:
            mask, outcomes = found.pop("_outcome"), found.pop("outcome")
            assert [outcomes[k].env_id for k in np.flatnonzero(mask)] == [
                f"env-{k}" for k in np.flatnonzero(mask)
            ]
            assert all(outcomes[k].blame in ("env", "either") for k in np.flatnonzero(mask))
    if "worker_restarted" in infos:
        assert all(infos["worker_restarted"][infos["_worker_restarted"]])
        if mode == AutoresetMode.SAME_STEP:  # There the info of the reset has it too.
            for key in ("worker_restarted", "_worker_restarted"):
                del infos[key]
        else:
            infos["worker_restarted"] = infos["_worker_restarted"]
    if "worker_restarted" in infos.get("final_info", {}):
        final = infos["final_info"]
        final["worker_restarted"] = final["_worker_restarted"]
    if "episode" in infos:
        del infos["episode"]["t"]
    return stepped


def both_do(ours: Any, theirs: Any, mode: AutoresetMode, actions: Any) -> None:
    """Step both; reset envs whose episode has ended if the mode doesn't."""
    assert_alike(ours.reset(), theirs.reset())
    for step, chosen in enumerate(actions):
        found, expected = ours.step(chosen), theirs.step(chosen)
        assert_alike(plainly(found, mode), plainly(expected, mode), f"step {step}: {chosen}")
        done = expected[2] | expected[3]
        if mode == AutoresetMode.DISABLED and done.any():
            found, expected = (env.reset(options={"reset_mask": done}) for env in (ours, theirs))
            assert_alike(found, expected)


_DIE, _TERMINATE, _TRUNCATE, _STEP = 0, 2, 3, 4
SINGLE_AND_TOGETHER = np.array(
    [
        [_STEP, _STEP, _STEP], [_DIE, _STEP, _STEP], [_DIE, _STEP, _TERMINATE],
        [_DIE, _STEP, _DIE], [_STEP, _DIE, _STEP], [_STEP, _STEP, _STEP], [_DIE, _DIE, _DIE],
        [_STEP, _DIE, _STEP], [_TERMINATE, _STEP, _TRUNCATE], [_DIE, _TRUNCATE, _STEP],
        [_STEP, _STEP, _DIE],
    ]
)  # fmt: skip
"""Actions of three envs: single losses, several in a row, and losses of all."""


@pytest.mark.parametrize("mode", MODES)
def test_a_death_looks_like_an_episode_that_is_cut_short(mode: AutoresetMode) -> None:
    """Also to Gymnasium's wrappers; single deaths, several in a row, and with ignored actions."""

    def wrap(envs: Any) -> Any:
        if mode == AutoresetMode.NEXT_STEP:
            envs = wrappers.NormalizeObservation(envs)
        if (
            mode == AutoresetMode.DISABLED
        ):  # In this mode `SyncVectorEnv` hides masks from wrappers.
            return envs
        return wrappers.NormalizeReward(wrappers.RecordEpisodeStatistics(envs))

    ours, theirs = wrap(mortals(mode, dies=True)), wrap(mortals(mode, dies=False))
    both_do(ours, theirs, mode, SINGLE_AND_TOGETHER)
    ours.close()


@pytest.mark.parametrize("place", [{"placement": "inline"}, {"envs_per_process": 3}])
@pytest.mark.parametrize("mode", MODES)
def test_an_exception_looks_like_an_episode_that_is_cut_short(
    mode: AutoresetMode, place: dict[str, Any]
) -> None:
    """With ``on_env_error: restart``; others of the same process go on."""
    ours, theirs = raising(mode, place), mortals(mode, dies=False)
    both_do(ours, theirs, mode, SINGLE_AND_TOGETHER)
    ours.close()


@pytest.mark.parametrize("mode", MODES)
def test_a_hang_looks_like_an_episode_that_is_cut_short(mode: AutoresetMode) -> None:
    hang, step = 1, 4
    ours, theirs = mortals(mode, dies=True, step_timeout=2.0), mortals(mode, dies=False)
    both_do(ours, theirs, mode, [[step] * 3, [step, hang, step], [step] * 3, [step] * 3])
    ours.close()


def step_until_one_has_ended(envs: Any) -> int:
    """Step until one of the first two has ended; return its position."""
    envs.action_space.seed(0)
    for seed in range(99):
        envs.reset(seed=seed)
        for _ in range(60):
            _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
            done = (terminated | truncated)[:2]
            if done.sum() == 1:
                return int(done.argmax())
    raise AssertionError("they end together")


def test_one_that_was_about_to_be_reset_has_lost_nothing() -> None:
    """It begins its episode, while the other env of the worker has lost its episode."""
    envs = made()
    due = step_until_one_has_ended(envs)
    shown, lost = envs._observations.copy(), 1 - due
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    observations, rewards, terminated, truncated, infos = envs.step_wait()
    assert infos["_worker_restarted"].tolist() == LOST
    assert truncated[[due, lost]].tolist() == [False, True]
    assert not terminated[:2].any()
    assert rewards[:2].tolist() == [0, 0]
    np.testing.assert_array_equal(observations[lost], shown[lost])
    first = observations[due].copy()
    assert abs(first[1:] - [0, 0, 0, 0, *[0] * 6]).max() < 0.01
    observations, rewards, terminated, truncated, infos = envs.step(ACTIONS)
    assert rewards[lost] == 0 != rewards[due]
    assert not (terminated | truncated)[:2].any()
    assert abs(observations[lost][1:]).max() < 0.01
    assert "worker_restarted" not in infos
    _, rewards, _, _, _ = envs.step(ACTIONS)
    assert (rewards[:2] != 0).all()
    envs.close()


@pytest.mark.parametrize("mode", MODES)
def test_a_state_after_a_death_begins_the_next_episode(mode: AutoresetMode) -> None:
    """Of the envs that have lost theirs; the others are where they were. No step is a reset."""
    envs = VectorEnv([Counted] * 4, envs_per_process=2, autoreset_mode=mode)
    actions = np.zeros(4, np.int64)
    envs.reset(seed=0)
    envs.step(actions)
    killed(envs.group, lambda: envs.step_async(actions))
    assert envs.step_wait()[3].tolist() == LOST
    kept = envs.snapshot()
    for _ in range(2):
        observations, infos = envs.restore(kept)
        assert observations.tolist() == [[1, 0], [1, 0], [1, 2], [1, 2]]
        assert infos["_count"].tolist() == [not lost for lost in LOST]
        observations, rewards, _, _, _ = envs.step(actions)
        assert observations.tolist() == [[1, 1], [1, 1], [1, 3], [1, 3]]
        assert rewards.all()
    envs.close()


@pytest.mark.parametrize("mode", MODES)
def test_a_restored_env_that_was_to_be_reset_loses_nothing_by_a_death(mode: AutoresetMode) -> None:
    """It has no episode in NEXT_STEP; in other modes, the episode that is going on is lost."""
    envs = VectorEnv([Counted] * 2, envs_per_process=1, autoreset_mode=mode)
    envs.reset(seed=0)
    ended = envs.step(np.array([1, 0]))[2]
    assert ended.tolist() == [True, False]
    kept = envs.snapshot()
    envs.reset(seed=0)
    envs.restore(kept)
    killed(envs.group, lambda: envs.step_async(np.zeros(2, np.int64)))
    _, rewards, _, truncated, infos = envs.step_wait()
    assert infos["_worker_restarted"].tolist() == [True, False]
    assert truncated.tolist() == [mode != AutoresetMode.NEXT_STEP, False]
    assert rewards.tolist() == [0, 1]
    envs.close()


def test_a_second_death_during_resets() -> None:
    """Only the env that was stepped loses its new episode; the other one is reset all the same."""
    envs = made(max_restarts=5)
    due = step_until_one_has_ended(envs)
    lost = 1 - due
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    envs.step_wait()
    shown = envs._observations.copy()
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    observations, rewards, _, truncated, infos = envs.step_wait()
    assert infos["_worker_restarted"].tolist() == LOST
    assert truncated.tolist() == [k == due for k in range(4)]
    assert rewards[:2].tolist() == [0, 0]
    np.testing.assert_array_equal(observations[due], shown[due])
    assert abs(observations[lost][1:]).max() < 0.01
    _, rewards, _, truncated, infos = envs.step(ACTIONS)
    assert rewards[due] == 0 != rewards[lost]
    assert not truncated.any()
    assert "worker_restarted" not in infos
    envs.close()


def test_a_death_in_a_reset_or_a_call(twins: Any) -> None:
    """A reset still begins episodes, without its seeds, and reports the cause; a call ends in an
    error, and the next step is the one that tells.
    """
    envs = made()
    killed(envs.group, lambda: envs.reset_async(seed=7))
    observations, infos = envs.reset_wait()
    assert infos["_worker_restarted"].tolist() == LOST
    np.testing.assert_array_equal(observations[2:], twins.reset(seed=7)[0][2:])
    assert not envs.step(ACTIONS)[3].any()
    killed(envs.group, lambda: None)
    with pytest.raises(WorkerDied, match="env 'env-0'"):
        envs.get_attr("dt")
    assert envs.step(ACTIONS)[3].tolist() == LOST
    mask = np.array([True, False, True, False])
    envs.reset(options={"reset_mask": mask})
    _, rewards, _, truncated, _ = envs.step(ACTIONS)
    assert (rewards == 0).tolist() == [False, True, False, False]
    assert not truncated.any()
    assert (envs.step(ACTIONS)[1] != 0).all()
    envs.close()


def test_a_death_raises_if_configured() -> None:
    """Each time, as the worker is not replaced."""
    envs = made(on_worker_death="raise")
    envs.reset(seed=7)
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    with pytest.raises(WorkerDied, match=r"env 'env-0'.*was killed by SIGKILL"):
        envs.step_wait()
    with pytest.raises(WorkerDied, match="env 'env-0'"):
        envs.reset()
    envs.close()


@pytest.fixture
def sb3_mortals() -> Iterator[Any]:
    """Two envs behind Stable-Baselines3's interface; some random actions kill the worker."""
    pytest.importorskip("stable_baselines3")
    from rlightning_aio.sb3 import VecEnv

    makers = [lambda k=k: Mortal(k, dies=True) for k in range(2)]
    envs = VecEnv(makers, envs_per_process=1, max_restarts=9, step_timeout=2.0)
    yield envs
    envs.close()


def taken(before: Any, action: int) -> Any:
    """Results of a step from a given observation."""
    env = Mortal(int(before[0]), dies=False)
    env.count, env.sum = int(before[1]), int(before[2])
    return env.step(action)


@pytest.mark.simulators
def test_a_replay_buffer_holds_only_steps_that_were_taken(sb3_mortals: Any) -> None:
    """In a run with deaths and hangs."""
    from stable_baselines3 import DQN

    model = DQN("MlpPolicy", sb3_mortals, learning_starts=99, buffer_size=99, seed=1, device="cpu")
    buffer = model.learn(60).replay_buffer
    for step, k in np.ndindex(buffer.pos, 2):
        before, action = buffer.observations[step, k], int(buffer.actions[step, k, 0])
        observation, reward, terminated, truncated, _ = taken(before, action)
        np.testing.assert_array_equal(buffer.next_observations[step, k], observation)
        assert buffer.rewards[step, k] == reward
        assert buffer.dones[step, k] == (terminated or truncated)
        assert buffer.timeouts[step, k] == truncated
    assert {0, 1} < set(buffer.actions[: buffer.pos].flatten().tolist())


@pytest.mark.simulators
def test_a_rollout_buffer_begins_an_episode_after_a_death(sb3_mortals: Any) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    envs = VecMonitor(sb3_mortals)
    model = PPO("MlpPolicy", envs, n_steps=30, batch_size=60, seed=3, device="cpu", gamma=0.0)
    buffer = model.learn(60).rollout_buffer
    # Swapped and flattened for training: all of one env, then all of the next.
    observations, actions = (a.reshape(2, 30, -1) for a in (buffer.observations, buffer.actions))
    for k, step in np.ndindex(2, 29):
        before, action = observations[k, step], int(actions[k, step, 0])
        observation, _, terminated, truncated, _ = taken(before, action)
        first = [k, 0, 0]
        expected = first if terminated or truncated else observation
        np.testing.assert_array_equal(observations[k, step + 1], expected)
    assert {0, 1} < set(actions.flatten().tolist())
    episodes = model.ep_info_buffer
    ends = sum(int(action) < 4 for action in actions.flatten())
    assert len(episodes) == ends


@pytest.mark.parametrize("mode", MODES)
def test_a_masked_reset_leaves_it_to_the_next_step_to_tell_of_other_lost_episodes(
    mode: AutoresetMode,
) -> None:
    """Three envs of one worker, which dies between two calls; one of them is to be reset."""
    envs = VectorEnv([Counted] * 3, envs_per_process=3, autoreset_mode=mode)
    nothing = np.zeros(3, np.int64)
    envs.reset(seed=0)
    envs.step(nothing)
    kill(envs.group.get_workers()[0]["pid"])
    first, infos = envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert first[:, 1].tolist() == [1, 0, 1]
    assert not infos.get("_worker_restarted", nothing)[[0, 2]].any()
    _, rewards, _, truncated, infos = envs.step(nothing)
    assert truncated.tolist() == infos["_worker_restarted"].tolist() == [True, False, True]
    assert rewards.tolist() == [0, 1, 0]
    envs.close()


ACTIONS_BEFORE = {"a reset": [0], "an end": [0, 1]}
"""Actions before a death, after a reset, by what came last."""
CAUSES = {"worker_restarted", "env_at_fault", "outcome"}
"""Keys of an info that tell of a death."""


def observed(envs: VectorEnv, actions: list[int], ends: Any) -> tuple[list[Any], Any]:
    """Take actions in the envs of the mask `ends`; in the others, do nothing.

    Returns all observations, and a mask of the envs that the program must reset next.
    """
    shown, due = [envs.reset()[0]], np.zeros(envs.num_envs, np.bool_)
    for action in actions:
        if due.any():
            shown.append(envs.reset(options={"reset_mask": due})[0])
            due = np.zeros_like(due)
        else:
            observation, _, terminated, truncated, _ = envs.step(action * ends)
            shown.append(observation)
            if envs.autoreset_mode == AutoresetMode.DISABLED:
                due = terminated | truncated
    return shown, due


@pytest.fixture
def closed_after() -> Iterator[list[Any]]:
    """A list of vector envs to close."""
    made: list[Any] = []
    yield made
    for envs in made:
        envs.close()


@pytest.mark.parametrize("before", ACTIONS_BEFORE)
@pytest.mark.parametrize("mode", MODES)
def test_what_a_lost_step_reports_is_of_the_episode_that_was_lost(
    mode: AutoresetMode, before: str, closed_after: list[Any]
) -> None:
    """Also where the one before has just ended."""
    at_once = mode == AutoresetMode.SAME_STEP
    envs = VectorEnv([Counted] * 2, autoreset_mode=mode, envs_per_process=1)
    closed_after.append(envs)
    lost, nothing = np.array([True, False]), np.zeros(2, int)
    shown, due = observed(envs, ACTIONS_BEFORE[before], lost)
    if due.any():
        killed(envs.group, lambda: envs.reset_async(options={"reset_mask": due}))
        observation, infos = envs.reset_wait()
        truncated = ~lost & lost
    else:
        killed(envs.group, lambda: envs.step_async(nothing))
        observation, reward, terminated, truncated, infos = envs.step_wait()
        assert (reward.tolist(), terminated.any()) == ((~lost).tolist(), False)
    assert infos["_worker_restarted"].tolist() == lost.tolist()
    assert all("was killed by SIGKILL" in cause for cause in infos["worker_restarted"][lost])
    if before == "an end" and not at_once:  # It was about to be reset, and has lost nothing.
        assert (truncated.any(), "final_obs" in infos) == (False, False)
        assert observation[lost].tolist() == [[1, 0]]
        return
    last, causes = shown[-1][lost].tolist(), CAUSES | {f"_{cause}" for cause in CAUSES}
    assert truncated.tolist() == lost.tolist()
    if at_once:
        assert observation[lost].tolist() == [[1, 0]]
        assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == lost.tolist()
        assert [row.tolist() for row in infos["final_obs"][lost]] == last
        assert infos["final_info"].keys() == causes
    else:
        assert observation[lost].tolist() == last
        assert infos.keys() == causes | {"count", "_count"}
        assert infos["_count"].tolist() == (~lost).tolist()
    if mode == AutoresetMode.NEXT_STEP:
        observation, reward, _, truncated, _ = envs.step(nothing)
        assert (reward.tolist(), truncated.any()) == ((~lost).tolist(), False)
        assert observation[lost][:, 1].tolist() == [0]


@pytest.mark.simulators
@pytest.mark.parametrize("before", ACTIONS_BEFORE)
def test_what_a_lost_step_reports_to_stable_baselines3(
    before: str, closed_after: list[Any]
) -> None:
    pytest.importorskip("stable_baselines3")
    from rlightning_aio.sb3 import VecEnv

    envs = VecEnv([Counted] * 2, envs_per_process=1)
    closed_after.append(envs)
    lost = np.array([True, False])
    envs.reset()
    shown = [envs.step(action * lost)[0] for action in ACTIONS_BEFORE[before]]
    pid = envs.group.get_workers()[0]["pid"]
    stop(pid)
    killer = threading.Timer(0.1, kill, [pid])
    killer.start()
    observation, reward, done, infos = envs.step(np.zeros(2, int))
    killer.join()
    assert (done.tolist(), reward.tolist()) == (lost.tolist(), (~lost).tolist())
    assert infos[0].keys() == CAUSES | {"terminal_observation", "TimeLimit.truncated"}
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"].tolist() == shown[-1][0].tolist()
    assert observation[0].tolist() == [1, 0]
    assert not envs.reset_infos[0].keys() & {"final_obs", "final_info"}
