"""Envs whose episodes differ in length, and the transitions that each of them must make.

`played` is the oracle: plain Gymnasium envs in a loop, and one list for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.adapted.same_step import SameStep

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy.typing as npt


class Uneven(gym.Env[Any, Any]):
    """Shows [resets and steps so far, steps of the episode, a number that depends on all before].

    All values are whole numbers, which every dtype on their way holds exactly.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    render_mode = "rgb_array"
    count = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.count = 0
        self.count += 1
        self.steps, self.length = 0, int(self.np_random.integers(1, 8))
        self.at = int(self.np_random.integers(1000))
        return self._observed(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 1
        self.steps += 1
        self.at = (7 * self.at + 3 * int(action[0]) + int(self.np_random.integers(1000))) % 1009
        over, odd = self.steps >= self.length, bool(self.length % 2)
        return self._observed(), float(self.at % 100), over and odd, over and not odd, {}

    def _observed(self) -> npt.NDArray[np.float64]:
        return np.array([self.count, self.steps, self.at], np.float64)

    def render(self) -> npt.NDArray[np.uint8]:
        return np.full((16, 16, 3), self.steps, np.uint8)


class Together(gym.vector.VectorEnv[Any, Any, Any]):
    """Several envs, none of which is reset before all are; an ended one is stepped further."""

    metadata: ClassVar = {"autoreset_mode": AutoresetMode.DISABLED, "render_fps": 10}
    render_mode = "rgb_array"

    def __init__(self, makers: Sequence[Callable[[], gym.Env[Any, Any]]]) -> None:
        self.envs = [make() for make in makers]
        self.num_envs = len(makers)
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        seeds = [None if seed is None else seed + k for k in range(self.num_envs)]
        pairs = zip(self.envs, seeds, strict=True)
        return np.stack([env.reset(seed=own)[0] for env, own in pairs]), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        pairs = zip(self.envs, actions, strict=True)
        *columns, _ = zip(*(env.step(action) for env, action in pairs), strict=True)
        observation, reward, terminated, truncated = map(np.array, columns)
        return observation, reward, terminated, truncated, {}

    def render(self) -> Any:
        return tuple(env.render() for env in self.envs)


def cart_pole() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1", disable_env_checker=True)


TASKS: dict[str, Callable[[], gym.Env[Any, Any]]] = {"uneven": Uneven, "CartPole": cart_pole}


def act(task: str, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """What the policy answers to observations ``[..., *obs]``: to each row by itself.

    So an env's actions follow from its seed, in whatever order results come.
    """
    if task == "CartPole":
        return (np.abs(observation[..., 3]) * 1000 % 2).astype(np.int64)
    return (5 * observation[..., 2:] + observation[..., 1:2]) % 17


@dataclass(frozen=True)
class Kind:
    """How many sub-environments an env has (0: it is none of several), and its autoreset mode."""

    width: int
    mode: str

    def make(self, task: str) -> Any:
        """An env of this kind."""
        one = TASKS[task]
        if not self.width:
            return SameStep(one()) if self.mode == "same_step" else one()
        if self.mode == "disabled":
            return Together([one] * self.width)
        return SyncVectorEnv([one] * self.width, autoreset_mode=AutoresetMode[self.mode.upper()])


KINDS = {
    "plain": Kind(0, "disabled"),
    "same step": Kind(0, "same_step"),
    "three, next step": Kind(3, "next_step"),
    "three, same step": Kind(3, "same_step"),
    "three together": Kind(3, "disabled"),
}


@dataclass(frozen=True)
class Transition:
    """One step of one env."""

    before: tuple[float, ...]
    action: tuple[float, ...]
    reward: float
    terminated: bool
    truncated: bool
    after: tuple[float, ...]
    first: bool


def as_tuple(value: Any) -> tuple[float, ...]:
    """Numbers of one row."""
    return tuple(np.ravel(value).tolist())


def played(
    task: str, mode: str, seeds: Sequence[int], limit: float, count: int
) -> list[list[Transition]]:
    """`count` transitions at least of each sub-environment of one env, one list for each.

    Args:
        task: of `TASKS`.
        mode: what a sub-environment does after its end. With ``disabled`` all are reset as soon
            as the last of them has ended.
        seeds: of the first reset, one for each.
        limit: steps after which all are reset together.
        count: of transitions.
    """
    envs = [TASKS[task]() for _ in seeds]
    lists: list[list[Transition]] = [[] for _ in envs]
    seen: list[Any] = []
    first, over = [True] * len(envs), [False] * len(envs)
    steps, is_due = 0, True
    while is_due or min(map(len, lists)) < count:
        if is_due:
            given = [None] * len(envs) if seen else seeds
            seen = [env.reset(seed=seed)[0] for env, seed in zip(envs, given, strict=True)]
            first, over = [True] * len(envs), [False] * len(envs)
            steps = 0
        begun = [mode == "next_step" and ended for ended in over]
        made: dict[int, tuple[Any, ...]] = {}
        for k, env in enumerate(envs):
            if begun[k]:
                seen[k], over[k] = env.reset()[0], False
                continue
            before, action = seen[k], act(task, seen[k])
            seen[k], reward, terminated, truncated, _ = env.step(action)
            if not over[k]:  # Else it waits for the others.
                made[k] = before, action, reward, terminated, truncated, seen[k]
                over[k] = bool(terminated or truncated)
        # An env that resets itself begins to count anew where all its episodes end or begin.
        steps = 0 if all(begun) or (mode != "disabled" and all(over)) else steps + 1
        for k, (before, action, reward, terminated, truncated, after) in made.items():
            numbers = as_tuple(before), as_tuple(action), float(reward)
            ends = bool(terminated), bool(truncated) or steps == limit
            lists[k].append(Transition(*numbers, *ends, as_tuple(after), first[k]))
            first[k] = over[k]
            if over[k] and mode == "same_step":
                seen[k], over[k] = envs[k].reset()[0], False
        is_due = steps == limit or (mode == "disabled" and all(over))
    for env in envs:
        env.close()
    return lists
