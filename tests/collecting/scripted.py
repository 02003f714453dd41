"""Envs that log their transitions, and a group with results in random order."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from rlightning_aio import sync
from rlightning_aio.batch import BatchedData, joined
from rlightning_aio.batch.data import parts_of
from rlightning_aio.envs.adapted.makers import SameStep
from rlightning_aio.errors import NothingPending
from rlightning_aio.protocol.slab import TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt


@dataclass
class Step:
    """A transition in the log of an env."""

    before: list[float]
    action: float
    reward: float
    terminated: bool
    truncated: bool
    after: list[float]


@dataclass
class Script(gym.Env[Any, Any]):
    """Observes [number of the env, episodes, steps]; episodes end at random."""

    number: int
    ends: float
    log: list[Step] = field(default_factory=list)
    generator: np.random.Generator = field(init=False)
    episode: int = 0
    steps: int = 0

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __post_init__(self) -> None:
        self.generator = np.random.default_rng(self.number)

    def _observation(self) -> npt.NDArray[np.float64]:
        return np.array([self.number, self.episode, self.steps], np.float64)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episode += 1
        self.steps = 0
        return self._observation(), {"acted": -1.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        before = self._observation().tolist()
        self.steps += 1
        chance = self.generator.random()
        terminated, truncated = chance < self.ends / 2, 1 - chance < self.ends / 2
        reward = float(self.generator.integers(100))
        after = self._observation()
        self.log.append(Step(before, action.item(), reward, terminated, truncated, after.tolist()))
        info: dict[str, Any] = {"acted": action.item()}
        if self.steps % 2:
            info["odd"] = np.True_
        return after, reward, terminated, truncated, info


class Tickets:
    """A policy with a unique number as each action."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, batch: BatchedData) -> dict[str, Any]:
        shape = batch.is_reset.shape
        numbers = self.count + np.arange(np.prod(shape), dtype=np.float64).reshape(shape)
        self.count += numbers.size
        return {"action": numbers[..., None], "log_prob": numbers.astype(np.float32)}


KINDS = {
    "single": lambda scripts: scripts[0],
    "same_step": lambda scripts: SameStep(scripts[0]),
    "vector": lambda scripts: SyncVectorEnv(
        [lambda s=s: s for s in scripts], autoreset_mode=AutoresetMode.NEXT_STEP
    ),
    "same_step_vector": lambda scripts: SyncVectorEnv(
        [lambda s=s: s for s in scripts], autoreset_mode=AutoresetMode.SAME_STEP
    ),
}


def scripted_group(
    kind: str, num_envs: int, ends: float
) -> tuple[sync.EnvGroup, dict[int, list[Step]]]:
    """Inline envs of a kind, and the log of each env or sub-environment by its index."""
    width = 2 if kind.endswith("vector") else 1
    scripts = [[Script(width * k + j, ends) for j in range(width)] for k in range(num_envs)]
    config = {
        "name": "script",
        "task": [lambda own=own: KINDS[kind](own) for own in scripts],
        "num_workers": num_envs,
        "placement": "inline",
    }
    group = sync.build_env_group(config)
    return group, {script.number: script.log for own in scripts for script in own}


class Disturbed:
    """A group with results in random order and random worker deaths.

    Args:
        group: of inline envs, which is executed at once.
        logs: of its envs; what is lost is taken out.
        choose: an int from 0 to its argument - 1.
        loses: whether a result is lost; interrupts: whether a wait is interrupted.
    """

    def __init__(
        self,
        group: sync.EnvGroup,
        logs: dict[int, list[Step]],
        choose: Callable[[int], int],
        loses: Callable[[], bool],
        interrupts: Callable[[], bool],
    ) -> None:
        self.group = group
        self.logs = logs
        self.pool: list[BatchedData] = []
        self.last: BatchedData | None = None
        self._choose, self._loses, self._interrupts = choose, loses, interrupts

    def __getattr__(self, name: str) -> Any:
        return getattr(self.group, name)

    @property
    def pending(self) -> list[str]:
        return [*self.group.pending, *(env_id for row in self.pool for env_id in row.env_ids())]

    def collect_async(
        self, min_results: int = 1, wait_all: bool = False
    ) -> tuple[BatchedData, list[bool]]:
        try:
            batch, _ = self.group.collect_async(wait_all=True)
            rows = [batch.take([k]) for k in range(len(batch))]
            self.pool += [self._lost(row) if self._loses() else row for row in rows]
        except NothingPending:
            pass
        if not self.pool:
            raise NothingPending("nothing was sent")
        if self._interrupts():
            raise InterruptedError
        count = len(self.pool)
        if not wait_all and count > min_results:
            count = min_results + self._choose(count - min_results + 1)
        chosen = [self.pool.pop(self._choose(len(self.pool))) for _ in range(count)]
        chosen.sort(key=lambda row: int(row.index.min()))
        self.last = joined(chosen)
        return self.last, self.last.limit_reached.reshape(count, -1).any(axis=1).tolist()

    def _lost(self, row: BatchedData) -> BatchedData:
        """The result of the env of a replaced worker."""
        for index, is_reset in zip(row.index.reshape(-1), row.is_reset.reshape(-1), strict=True):
            if not is_reset:
                self.logs[int(index)].pop()
        fresh, _ = self.group.reset(env_ids=row.env_ids())
        (part,) = parts_of(fresh)
        part.flags[..., TRUNCATED] = True
        part.restarted = np.ones(1, np.bool_)
        return fresh
