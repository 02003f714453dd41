"""The contenders that several questions share: this library, its peers, and the limit.

Rule: everybody gets the same single env from `gymnasium.make`, steps it with actions
sampled beforehand, and resets finished episodes, each in its own way. What counts is
results handed to the trainer; where an env is reset in place of a step (Gymnasium,
EnvPool, this library, the in-process loops), that result counts as well.
"""

from __future__ import annotations

import multiprocessing as mp
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib import import_module
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from harness import Contender, throughput

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from multiprocessing.connection import Connection

# Batches of actions that are sampled beforehand and used in turn.
NUM_ACTIONS = 64
# Steps between two looks at the clock, in loops so bare that a look would show.
STEPS_PER_LOOK = 64


@dataclass(frozen=True)
class Work:
    """What is stepped.

    Attributes:
        task: Gymnasium id.
        num_envs: how many, for contenders that run many.
        modules: imported wherever the env is made.
        backend: this library's name for the simulator.
        max_episode_steps: limit for tasks that have none of their own.
    """

    task: str
    num_envs: int
    modules: tuple[str, ...] = ()
    backend: str = "gymnasium"
    max_episode_steps: int | None = None

    def make(self) -> Any:
        """One env, as bare as `gymnasium.make` makes it."""
        import gymnasium as gym

        for module in self.modules:
            import_module(module)
        return gym.make(
            self.task, max_episode_steps=self.max_episode_steps, disable_env_checker=True
        )

    def makers(self) -> list[Callable[[], Any]]:
        return [self.make] * self.num_envs


def sampled(space: Any, num_envs: int) -> Iterator[Any]:
    """Batches of sampled actions, in turn and without end."""
    space.seed(0)
    batches = [
        np.stack([np.asarray(space.sample()) for _ in range(num_envs)]) for _ in range(NUM_ACTIONS)
    ]
    return cycle(batches)


# ---- this library


@dataclass
class _Ours(Contender):
    """What both kinds of group share.

    Attributes:
        envs_per_process: as in a config entry.
        auto_reset: whether finished episodes are looked for at all; envs that never end
            one need not.
    """

    name: str
    work: Work
    envs_per_process: int | str = "auto"
    auto_reset: bool = True

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", *self.work.modules)

    def config(self) -> dict[str, Any]:
        return {
            "name": "bench",
            "backend": self.work.backend,
            "task": self.work.task,
            "num_workers": self.work.num_envs,
            "max_episode_steps": self.work.max_episode_steps or self._own_limit(),
            "envs_per_process": self.envs_per_process,
            "imports": list(self.work.modules),
        }

    def _own_limit(self) -> int | None:
        import gymnasium as gym

        for module in self.work.modules:
            import_module(module)
        return gym.spec(self.work.task).max_episode_steps


@dataclass
class OursSync(_Ours):
    """`rlightning_aio.sync.EnvGroup`: all envs step, all results are awaited."""

    def setup(self) -> None:
        from rlightning_aio.sync import build_env_group

        self._stack = ExitStack()
        self._group = self._stack.enter_context(build_env_group(self.config()))
        if self.auto_reset:
            self._stack.enter_context(self._group.auto_reset())
        self._batch, _ = self._group.reset(seed=0)
        self._actions = sampled(self._group.get_action_spaces()[0], self.work.num_envs)

    def step(self) -> int:
        response = self._batch.respond(action=next(self._actions))
        self._batch, _ = self._group.step(response)
        _ = self._batch.observation, self._batch.reward
        return self.work.num_envs

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if hasattr(self, "_stack"):
            self._stack.close()


@dataclass
class OursAsync(_Ours):
    """`rlightning_aio.EnvGroup`: whoever is ready is collected and sent on.

    Attributes:
        min_results, max_results: of `collect_async`.
        uvloop: run on uvloop rather than on asyncio's own loop.
    """

    min_results: int = 1
    max_results: int | None = None
    uvloop: bool = True

    def setup(self) -> None:
        import asyncio

        from rlightning_aio import build_env_group

        loop_factory = import_module("uvloop").new_event_loop if self.uvloop else None
        self._runner = asyncio.Runner(loop_factory=loop_factory)
        self._group = build_env_group(self.config())
        self._runner.run(self._open())
        self._actions = sampled(self._group.get_action_spaces()[0], self.work.num_envs)
        self._send(self._first)

    async def _open(self) -> None:
        self._stack = ExitStack()
        await self._group.init()
        if self.auto_reset:
            self._stack.enter_context(self._group.auto_reset())
        self._first, _ = await self._group.reset(seed=0)

    def _send(self, batch: Any) -> None:
        self._group.step_async(batch.respond(action=next(self._actions)[: len(batch)]))

    async def collect(self, seconds: float) -> int:
        """Collect and send on for that long; how many results came."""
        clock = time.perf_counter
        count = 0
        until = clock() + seconds
        while clock() < until:
            batch, _ = await self._group.collect_async(
                min_results=self.min_results, max_results=self.max_results
            )
            _ = batch.observation, batch.reward
            self._send(batch)
            count += len(batch)
        return count

    async def _round(self, seconds: float) -> float:
        await self.collect(0.1 * seconds)
        began = time.perf_counter()
        count = await self.collect(0.9 * seconds)
        return count / (time.perf_counter() - began)

    def round(self, seconds: float) -> float:
        return self._runner.run(self._round(seconds))

    def teardown(self) -> None:
        if hasattr(self, "_runner"):
            self._runner.run(self._group.close())
            self._runner.close()


# ---- peers


@dataclass
class GymnasiumAsync(Contender):
    """`gymnasium.vector.AsyncVectorEnv` with shared memory: one process for each env."""

    name: str
    work: Work

    @property
    def requires(self) -> tuple[str, ...]:
        return ("gymnasium", *self.work.modules)

    def setup(self) -> None:
        from gymnasium.vector import AsyncVectorEnv

        self._envs = AsyncVectorEnv(self.work.makers(), shared_memory=True)
        self._actions = sampled(self._envs.single_action_space, self.work.num_envs)
        self._envs.reset(seed=0)

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if hasattr(self, "_envs"):
            self._envs.close()


@dataclass
class StableBaselines3(Contender):
    """`SubprocVecEnv` of Stable-Baselines3: one process for each env, results pickled."""

    name: str
    work: Work

    @property
    def requires(self) -> tuple[str, ...]:
        return ("stable_baselines3", *self.work.modules)

    def setup(self) -> None:
        from stable_baselines3.common.vec_env import SubprocVecEnv

        self._envs = SubprocVecEnv(self.work.makers())
        self._actions = sampled(self._envs.action_space, self.work.num_envs)
        self._envs.seed(0)
        self._envs.reset()

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if hasattr(self, "_envs"):
            self._envs.close()


@dataclass
class Tianshou(Contender):
    """`ShmemVectorEnv` of Tianshou: one process for each env; its user resets."""

    name: str
    work: Work

    @property
    def requires(self) -> tuple[str, ...]:
        return ("tianshou", *self.work.modules)

    def setup(self) -> None:
        from tianshou.env import ShmemVectorEnv

        self._envs = ShmemVectorEnv(self.work.makers())
        self._actions = sampled(self._envs.action_space[0], self.work.num_envs)
        self._envs.seed(0)
        self._envs.reset()

    def step(self) -> int:
        _, _, terminated, truncated, _ = self._envs.step(next(self._actions))
        ended = np.flatnonzero(terminated | truncated)
        if len(ended):
            self._envs.reset(ended)
        return self.work.num_envs

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if hasattr(self, "_envs"):
            self._envs.close()


@dataclass
class EnvPool(Contender):
    """EnvPool: the same tasks written anew in C++, stepped by its threads.

    Attributes:
        batch_size: results it hands out at a time; all envs if None (synchronous).
    """

    name: str
    work: Work
    batch_size: int | None = None

    @property
    def requires(self) -> tuple[str, ...]:
        return ("envpool",)

    def setup(self) -> None:
        import envpool

        self._envs = envpool.make(
            self.work.task,
            env_type="gymnasium",
            num_envs=self.work.num_envs,
            batch_size=self.batch_size or self.work.num_envs,
            seed=0,
        )
        self._actions = sampled(self._envs.action_space, self.work.num_envs)
        self._envs.async_reset()

    def step(self) -> int:
        _, rewards, _, _, info = self._envs.recv()
        self._envs.send(next(self._actions)[: len(rewards)], info["env_id"])
        return len(rewards)

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if hasattr(self, "_envs"):
            self._envs.close()


# ---- no runtime at all


class InLine:
    """Envs stepped one after the other in a plain loop, each reset where it has ended."""

    def __init__(self, work: Work, num_envs: int) -> None:
        self._envs = [work.make() for _ in range(num_envs)]
        for seed, env in enumerate(self._envs):
            env.reset(seed=seed)
        batches = sampled(self._envs[0].action_space, num_envs)
        # An element for each env: a Python number for Discrete, an array for Box.
        self._actions = cycle(
            [
                [row.item() if row.ndim == 0 else row for row in np.array(next(batches))]
                for _ in range(NUM_ACTIONS)
            ]
        )
        self._ended = [False] * num_envs
        self._passes = max(1, STEPS_PER_LOOK // num_envs)

    def step(self) -> int:
        ended = self._ended
        for _ in range(self._passes):
            for k, (env, action) in enumerate(zip(self._envs, next(self._actions), strict=True)):
                if ended[k]:
                    env.reset()
                    ended[k] = False
                else:
                    _, _, terminated, truncated, _ = env.step(action)
                    ended[k] = terminated or truncated
        return self._passes * len(self._envs)

    def close(self) -> None:
        for env in self._envs:
            env.close()


@dataclass
class InProcess(Contender):
    """All envs in a plain loop of the trainer's own process."""

    name: str
    work: Work

    @property
    def requires(self) -> tuple[str, ...]:
        return ("gymnasium", *self.work.modules)

    def setup(self) -> None:
        self._envs = InLine(self.work, self.work.num_envs)

    def round(self, seconds: float) -> float:
        return throughput(self._envs.step, seconds)

    def teardown(self) -> None:
        if hasattr(self, "_envs"):
            self._envs.close()


def _bare_loop(connection: Connection, work: Work, inherited: Sequence[Connection]) -> None:
    """One process of the limit; a round for each number of seconds that comes."""
    for other in inherited:
        other.close()
    envs = InLine(work, 1)
    connection.send(0.0)
    try:
        while True:
            connection.send(throughput(envs.step, connection.recv()))
    except EOFError:
        envs.close()


@dataclass
class Limit(Contender):
    """Bare in-process loops, one for each core, all running at once; nothing around them.

    Attributes:
        processes: how many; as many as there are cores if None.
    """

    name: str
    work: Work
    processes: int | None = None
    _loops: list[tuple[Any, Connection]] = field(default_factory=list)

    @property
    def requires(self) -> tuple[str, ...]:
        return ("gymnasium", *self.work.modules)

    def setup(self) -> None:
        import os

        context = mp.get_context("fork")
        for _ in range(self.processes or len(os.sched_getaffinity(0))):
            ours, theirs = context.Pipe()
            inherited = [ours, *(connection for _, connection in self._loops)]
            process = context.Process(target=_bare_loop, args=(theirs, self.work, inherited))
            process.start()
            theirs.close()
            self._loops.append((process, ours))
        for _, connection in self._loops:
            connection.recv()

    def round(self, seconds: float) -> float:
        for _, connection in self._loops:
            connection.send(seconds)
        return sum(connection.recv() for _, connection in self._loops)

    def teardown(self) -> None:
        for _, connection in self._loops:
            connection.close()
        for process, _ in self._loops:
            process.join()
