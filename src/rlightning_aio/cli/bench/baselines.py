"""Steps a config's envs without this package: in a plain loop, and in Gymnasium's vector envs.

Rule: the same simulations with the same random actions, and none of our code in a step.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np

from rlightning_aio.cli.bench.measuring import Costs, Limits, Round, Rule, as_round
from rlightning_aio.cli.measurement import cpu_seconds, memory_bytes
from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted
from rlightning_aio.policies.random_actions import sampler_of
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence
    from pathlib import Path

    from rlightning_aio.config import EnvConfig

__all__ = ["Baseline", "BaselineStand", "baselines_of", "opened_baseline"]

_PLAIN: Final = ("gymnasium", "mujoco")
"""Backends whose envs are those of `gymnasium.make`, unchanged."""
_MANY: Final = 128
"""Above this number, AsyncVectorEnv is left out: it starts a process for each env."""


@dataclass(frozen=True, eq=False)
class Baseline:
    """A way to step an entry's simulations without a group.

    Attributes:
        words: its name in tables.
    """

    words: str
    config: EnvConfig

    @property
    def configs(self) -> tuple[EnvConfig, ...]:
        """Return its only entry."""
        return (self.config,)

    @property
    def steps_here(self) -> bool:
        """Return True: an env of it, which has the spaces, is always in this process."""
        return True

    @property
    def num_sims(self) -> int:
        """Return the total number of simulations."""
        return self.config.num_workers * self.config.num_envs

    def as_json(self) -> dict[str, Any]:
        """Return its description for JSON."""
        return {"placement": "baseline", "num_envs": {self.config.name: self.num_sims}}


_LOOP, _SYNC, _ASYNC = "bare loop", "SyncVectorEnv", "AsyncVectorEnv"


def baselines_of(configs: Sequence[EnvConfig]) -> list[Baseline]:
    """Return the baselines for a config; none if Gymnasium alone can't make its envs."""
    config = configs[0]
    if len(configs) > 1 or config.backend not in _PLAIN or ENVS.registered(config.backend):
        return []
    if config.interpreter or config.env_vars:
        return []
    found = [Baseline(words, config) for words in (_LOOP, _SYNC, _ASYNC)]
    return found if found[0].num_sims <= _MANY else found[:2]


@contextlib.contextmanager
def opened_baseline(baseline: Baseline, seed: int) -> Generator[BaselineStand]:
    """Build and reset its envs.

    Raises what the simulator raises.
    """
    before = memory_bytes([os.getpid()])
    began = time.monotonic()
    envs = _made(baseline)
    try:
        started = time.monotonic()
        envs.reset(seed)
        reset = time.monotonic()
        grown = max(0, memory_bytes([os.getpid()]) - before)
        memory = memory_bytes(envs.pids) or grown
        yield BaselineStand(envs, Costs(started - began, reset - started, memory), seed)
    finally:
        envs.close()


class BaselineStand:
    """A baseline whose envs are built; a `measuring.Measurable`."""

    def __init__(self, envs: _Loop | _Vector, costs: Costs, seed: int) -> None:
        self.costs = costs
        self._envs = envs
        self._sample = sampler_of(envs.action_space, np.random.default_rng(seed))

    async def measure(self, rule: Rule, limits: Limits, trace: Path | None = None) -> Round:
        """Measure it; `rule` and `trace` have no effect."""
        del rule, trace
        self._round(Limits(limits.steps, limits.seconds / 10))
        return self._round(limits)

    def _round(self, limits: Limits) -> Round:
        envs, latencies = self._envs, list[float]()
        pids = [os.getpid(), *envs.pids]
        busy, steps = cpu_seconds(pids), 0
        began = now = time.monotonic()
        while limits.not_reached(steps, now - began):
            steps += envs.step(self._sample(envs.num_envs), latencies)
            now = time.monotonic()
        return as_round(steps, now - began, cpu_seconds(pids) - busy, np.array(latencies))


class _Loop:
    """A list of envs, stepped one after the other."""

    def __init__(self, makers: Sequence[Callable[[], Any]]) -> None:
        self._envs = [make() for make in makers]
        self.num_envs = len(self._envs)
        self.action_space: Any = self._envs[0].action_space
        self.pids: list[int] = []
        self._actions = gym.vector.utils.batch_space(self.action_space, self.num_envs)

    def reset(self, seed: int) -> None:
        for k, env in enumerate(self._envs):
            env.reset(seed=seed + k)

    def step(self, actions: Any, latencies: list[float]) -> int:
        """Step each env. Return the number of steps."""
        rows: Any = gym.vector.utils.iterate(self._actions, actions)
        for env, action in zip(self._envs, rows, strict=True):
            sent_at = time.monotonic()
            _, _, terminated, truncated, _ = env.step(action)
            latencies.append(time.monotonic() - sent_at)
            if terminated or truncated:
                env.reset()
        return self.num_envs

    def close(self) -> None:
        for env in self._envs:
            env.close()


class _Vector:
    """One of Gymnasium's vector envs; `close` ends it even during a step."""

    def __init__(self, envs: Any, **close: Any) -> None:
        self._envs = envs
        self._close = close
        self.num_envs = int(envs.num_envs)
        self.action_space: Any = envs.single_action_space
        self.pids = [process.pid for process in getattr(envs, "processes", ())]
        self._done = np.zeros(self.num_envs, np.bool_)

    def reset(self, seed: int) -> None:
        self._envs.reset(seed=seed)

    def step(self, actions: Any, latencies: list[float]) -> int:
        """Step all envs. Return the number of steps that were no resets."""
        sent_at = time.monotonic()
        _, _, terminated, truncated, _ = self._envs.step(actions)
        latencies.append(time.monotonic() - sent_at)
        resets = int(self._done.sum())
        self._done = terminated | truncated
        return self.num_envs - resets

    def close(self) -> None:
        self._envs.close(**self._close)


def _made(baseline: Baseline) -> _Loop | _Vector:
    config = baseline.config
    options: dict[str, Any] = {
        "max_episode_steps": config.max_episode_steps,
        # As in our workers.
        "disable_env_checker": True,
        **config.env_kwargs,
    }

    def make() -> Any:
        with outdated_assets_accepted():
            return gym.make(config.task_name, **options)

    makers = [make] * baseline.num_sims
    if baseline.words == _LOOP:
        return _Loop(makers)
    if baseline.words == _SYNC:
        return _Vector(gym.vector.SyncVectorEnv(makers))
    with _deaf():
        return _Vector(gym.vector.AsyncVectorEnv(makers), terminate=True)


@contextlib.contextmanager
def _deaf() -> Generator[None]:
    """Make processes that start in this context ignore Ctrl-C and end silently on SIGTERM; the
    command ends them.
    """
    ways = {signal.SIGINT: signal.SIG_IGN, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, way) for number, way in ways.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
