"""Results of a group equal those of plain `gymnasium.make`, bit for bit.

The bare simulators are stepped once for each task. Every placement, number of workers and order of
arrival is compared with these trajectories, including resets and infos.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from random import Random
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from group import sample_envs
from gymnasium.vector.utils import batch_space, iterate

from rlightning_aio import BatchedData, PolicyResponse, build_env_group

if TYPE_CHECKING:
    from collections.abc import Iterable

NUM_STEPS = 160
SEED = 11


class Outcome(NamedTuple):
    """The return values of one call of an env."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    limit_reached: bool


@dataclass(frozen=True)
class Task:
    """A simulator, the limit of its episodes, and the backend that runs it.

    `num_envs` is the largest number of its envs in a group; each one needs a bare env.
    """

    backend: str
    name: str
    limit: int
    imports: tuple[str, ...] = ()
    num_envs: int = 4

    def entry(self, name: str, placement: dict[str, Any]) -> dict[str, Any]:
        return {
            "name": name,
            "backend": self.backend,
            "task": self.name,
            "max_episode_steps": self.limit,
            "imports": list(self.imports),
            **placement,
        }


PLACEMENTS: dict[str, dict[str, Any]] = {
    "inline": {"placement": "inline", "num_workers": 2},
    "one": {"envs_per_process": 2, "num_workers": 2},
    "two": {"envs_per_process": 2, "num_workers": 4},
    "four": {"envs_per_process": 1, "num_workers": 4},
    "eight": {"envs_per_process": 1, "num_workers": 8},
}

CARTPOLE = Task("gymnasium", "CartPole-v1", 25, num_envs=8)
TREE = Task("gymnasium", "Tree-v0", 40, ("group.sample_envs",))
HOPPER = Task("mujoco", "Hopper-v5", 20)
MUJOCO = {
    Task("mujoco", "HalfCheetah-v5", 70): ("inline", "two"),
    HOPPER: ("one", "four"),
    Task("mujoco", "Ant-v5", 70, num_envs=2): ("inline", "one"),
    Task("mujoco", "Humanoid-v5", 70, num_envs=2): ("inline", "one"),
}
"""In two placements, with as few envs as possible, because bare envs take time, too."""
TOGETHER = ("inline", "one", "two", "four")
EACH = [(CARTPOLE, (name,)) for name in ("inline", "one", "two", "eight")]
"""The entries of a group: one for each placement, or a group for each."""


@cache
def actions_of(task: Task) -> list[list[Any]]:
    """Return one action for each env, for each step."""
    assert sample_envs  # Registers the tasks that Gymnasium doesn't have.
    env = gym.make(task.name)
    space = batch_space(env.action_space, task.num_envs)
    env.close()
    space.seed(SEED)
    return [list(iterate(space, space.sample())) for _ in range(NUM_STEPS)]


@cache
def bare(task: Task) -> list[list[Outcome]]:
    """Return the trajectory of each env, stepped in a plain loop."""
    trajectories: list[list[Outcome]] = []
    for k, actions in enumerate(zip(*actions_of(task), strict=True)):
        env = gym.make(task.name, max_episode_steps=task.limit)
        observation, info = env.reset(seed=SEED + k)
        outcomes = [Outcome(observation, 0.0, False, False, info, False)]
        steps, ended = 0, False
        for action in actions:
            if ended:
                observation, info = env.reset()
                outcomes.append(Outcome(observation, 0.0, False, False, info, False))
                steps, ended = 0, False
            else:
                steps += 1
                result = env.step(action)
                outcomes.append(Outcome(*result, steps >= task.limit))
                ended = result[2] or result[3]
        env.close()
        trajectories.append(outcomes)
    return trajectories


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray | np.generic):
        return one.dtype == other.dtype and np.array_equal(one, other)
    return type(one) is type(other) and one == other


class Recorder:
    """Compares each env's results with its bare trajectory, in any order of arrival."""

    def __init__(self, task: Task, env_ids: list[str]) -> None:
        self.expected = bare(task)
        self.actions = actions_of(task)
        self.calls = dict.fromkeys(env_ids, 0)

    def check(self, batch: BatchedData, flags: list[bool]) -> None:
        for position, (env_id, ret) in enumerate(batch):
            k = int(env_id.rpartition("-")[2])
            expected = self.expected[k][self.calls[env_id]]
            info = {key: value for key, value in ret.info.items() if key != "episode"}
            found = Outcome(
                ret.observation,
                float(batch.reward[position]),
                ret.last_terminated,
                ret.last_truncated,
                info,
                flags[position],
            )
            assert same(found, expected._replace(reward=float(expected.reward))), (
                env_id,
                self.calls[env_id],
            )
            self.calls[env_id] += 1

    def answer(self, batch: BatchedData) -> BatchedData:
        """Return responses for the envs of `batch` that have steps left."""
        ids = [env_id for env_id in batch.ids() if self.calls[env_id] <= NUM_STEPS]
        return BatchedData(ids, [PolicyResponse(id_, self.action(id_)) for id_ in ids])

    def action(self, env_id: str) -> Any:
        return self.actions[self.calls[env_id] - 1][int(env_id.rpartition("-")[2])]

    def assert_complete(self) -> None:
        assert set(self.calls.values()) == {NUM_STEPS + 1}


def seeds(env_ids: list[str]) -> dict[str, int]:
    return {env_id: SEED + int(env_id.rpartition("-")[2]) for env_id in env_ids}


async def run_async(task: Task, placements: Iterable[str]) -> None:
    entries = [task.entry(name, PLACEMENTS[name]) for name in placements]
    draw = Random(0)
    async with build_env_group(entries) as group:
        recorder = Recorder(task, group.env_ids)
        batch, flags = await group.reset(seed=seeds(group.env_ids))
        recorder.check(batch, flags)
        pending = 0
        with group.auto_reset():
            while pending or any(calls <= NUM_STEPS for calls in recorder.calls.values()):
                answer = recorder.answer(batch)
                if len(answer):
                    group.step_async(answer)
                    pending += len(answer)
                batch, flags = await group.collect_async(min_results=draw.randint(1, 6))
                pending -= len(batch)
                recorder.check(batch, flags)
        recorder.assert_complete()


def shown(value: Any) -> str:
    return value.name if isinstance(value, Task) else " ".join(value)


@pytest.mark.parametrize(("task", "placements"), EACH, ids=shown)
async def test_trajectories_collected_as_they_come(task: Task, placements: tuple[str, ...]) -> None:
    """With results in any order, on either event loop."""
    await run_async(task, placements)


@pytest.mark.parametrize(("task", "placements"), [(TREE, TOGETHER), *MUJOCO.items()], ids=shown)
@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_more_trajectories_collected_as_they_come(
    task: Task, placements: tuple[str, ...]
) -> None:
    """Every kind of space, and every task of MuJoCo that has a model of its own."""
    await run_async(task, placements)


def test_the_bare_trajectories_have_resets_and_ends_of_both_kinds() -> None:
    """So the comparisons are not trivial."""
    for task in (*MUJOCO, CARTPOLE, TREE):
        outcomes = [outcome for trajectory in bare(task) for outcome in trajectory]
        assert len(outcomes) == task.num_envs * (NUM_STEPS + 1)
        ends = {(outcome.terminated, outcome.truncated) for outcome in outcomes}
        assert (True, False) in ends or task.name == "HalfCheetah-v5"
        assert (False, True) in ends or task.name == "Humanoid-v5"
