"""Steps a config's envs without this package: in a plain loop, and in Gymnasium's vector envs.

Rule: the same simulations with random actions, which obey action masks, and none of our code in a
step.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np

from rlightning_aio.cli.measuring import Place, Round, Rule, as_round
from rlightning_aio.envs.adapted.films import RECORD_VIDEO
from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted
from rlightning_aio.policies.random_actions import (
    allowed_action,
    can_be_masked,
    has_masks,
    sampler_of,
)
from rlightning_aio.registry import ENVS
from rlightning_aio.types import EnvRet

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence

    from rlightning_aio.cli.measuring import Measure
    from rlightning_aio.config import EnvConfig

_PLAIN: Final = ("gymnasium", "mujoco")
"""Backends whose envs are those of `gymnasium.make`, unchanged."""
_MANY: Final = 128
"""Above this number, AsyncVectorEnv is left out: it starts a process for each env."""
_OURS: Final = (RECORD_VIDEO, "num_threads")
"""Arguments that `gymnasium.make` doesn't know."""
_CLOSE_SECONDS: Final = 2.0
"""Time for AsyncVectorEnv to end a step that Ctrl-C has interrupted."""


@dataclass(frozen=True, eq=False)
class Baseline(Place):
    """A way to step an entry's simulations without a group."""

    words: str
    config: EnvConfig

    @property
    def num_sims(self) -> int:
        """Return the total number of simulations."""
        return self.config.num_workers * self.config.num_envs

    def as_json(self) -> dict[str, Any]:
        """Return its description for JSON."""
        return {"placement": "baseline", "num_envs": {self.config.name: self.num_sims}}

    @contextlib.asynccontextmanager
    async def opened(self, seed: int | None) -> AsyncGenerator[Measure]:
        """Build and reset its envs; see `Place`."""
        envs = _made(self)
        try:
            yield _OpenBaseline(envs, seed).measure
        finally:
            envs.close()


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


class _OpenBaseline:
    """A baseline whose envs are built."""

    def __init__(self, envs: _Loop | _Vector, seed: int | None) -> None:
        self._envs, self._rng = envs, np.random.default_rng(seed)
        self._sample = sampler_of(envs.action_space, self._rng)
        envs.reset(seed)
        self._is_masked = can_be_masked(envs.action_space) and has_masks(envs.newest())

    async def measure(self, rule: Rule, seconds: float) -> Round:
        """Step for `seconds`, after a tenth that does not count."""
        del rule
        self._round(seconds / 10)
        return self._round(seconds)

    def _round(self, seconds: float) -> Round:
        envs, latencies, steps = self._envs, list[float](), 0
        began = now = time.monotonic()
        while not steps or now - began < seconds:
            actions = self._sample(envs.num_envs)
            if self._is_masked:
                actions = allowed_action(envs.action_space, actions, envs.newest(), self._rng)
            sent_at = time.monotonic()
            steps += envs.step(actions)
            now = time.monotonic()
            latencies.append(now - sent_at)
        return as_round(steps, now - began, np.array(latencies))


class _Loop:
    """A list of envs, stepped one after the other."""

    def __init__(self, makers: Sequence[Callable[[], Any]]) -> None:
        self._envs = [make() for make in makers]
        self.num_envs = len(self._envs)
        self.action_space: Any = self._envs[0].action_space
        self._actions = gym.vector.utils.batch_space(self.action_space, self.num_envs)
        self._results: list[tuple[Any, dict[str, Any]]] = [(None, {})] * self.num_envs

    def reset(self, seed: int | None) -> None:
        for k, env in enumerate(self._envs):
            self._results[k] = env.reset(seed=None if seed is None else seed + k)

    def newest(self) -> EnvRet:
        """Return the masks of the newest results, as of one vectorised env."""
        masks = [
            (info if "action_mask" in info else observation)["action_mask"]
            for observation, info in self._results
            if has_masks(EnvRet(env_id="", observation=observation, info=info))
        ]
        info = {"action_mask": np.stack(masks)} if masks else {}
        return EnvRet(env_id="", observation=None, info=info)

    def step(self, actions: Any) -> int:
        """Step each env. Return the number of steps."""
        rows: Any = gym.vector.utils.iterate(self._actions, actions)
        for k, (env, action) in enumerate(zip(self._envs, rows, strict=True)):
            observation, _, terminated, truncated, info = env.step(action)
            self._results[k] = env.reset() if terminated or truncated else (observation, info)
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
        self._done = np.zeros(self.num_envs, np.bool_)
        self._result: tuple[Any, Any] = (None, None)

    def reset(self, seed: int | None) -> None:
        self._result = self._envs.reset(seed=seed)

    def newest(self) -> EnvRet:
        """Return the newest results, as of one vectorised env."""
        return EnvRet(env_id="", observation=self._result[0], info=self._result[1])

    def step(self, actions: Any) -> int:
        """Step all envs. Return the number of steps that were no resets."""
        observation, _, terminated, truncated, info = self._envs.step(actions)
        self._result = observation, info
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
        **{name: value for name, value in config.env_kwargs.items() if name not in _OURS},
    }

    def make() -> Any:
        with outdated_assets_accepted():
            return gym.make(config.task_name, **options)

    makers = [make] * baseline.num_sims
    if baseline.words == _LOOP:
        return _Loop(makers)
    if baseline.words == _SYNC:
        return _Vector(gym.vector.SyncVectorEnv(makers))
    return _Vector(gym.vector.AsyncVectorEnv(makers), timeout=_CLOSE_SECONDS)
