"""The contenders that several questions share: this library and its peers.

Rule: all contenders get the same single env from `gymnasium.make`, step it with actions sampled
beforehand, and reset finished episodes, each in its own way. They are measured by the results
handed to the trainer; where an env is reset in place of a step (Gymnasium, EnvPool, this
library), that result counts as well. Ours has time limits wherever there are workers.
"""

from __future__ import annotations

import math
import multiprocessing as mp
import os
import time
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from harness import Contender, throughput

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

CORES = len(os.sched_getaffinity(0))
# Number of batches of actions, sampled beforehand and used in turn.
NUM_ACTIONS = 64


@dataclass(frozen=True)
class Work:
    """The workload.

    Attributes:
        task: Gymnasium id; ``module:id`` imports the module first.
        num_envs: number of envs.
        step_timeout: this library's time limit; None for no limit.
        envs_per_process: of groups and of TorchRL, where the library's own choice is not meant.
    """

    task: str
    num_envs: int
    step_timeout: float | None = 60.0
    envs_per_process: int | None = None

    @property
    def modules(self) -> tuple[str, ...]:
        """Return the module that has the task, if it is not Gymnasium's."""
        module, colon, _ = self.task.partition(":")
        return (module,) if colon else ()

    def make(self) -> Any:
        """Return one env, as bare as `gymnasium.make` makes it."""
        import gymnasium as gym

        return gym.make(self.task, disable_env_checker=True)

    def makers(self) -> list[Callable[[], Any]]:
        return [self.make] * self.num_envs

    def fields(self) -> dict[str, Any]:
        """Return the fields of a config entry that say how envs run."""
        given = {"step_timeout": self.step_timeout, "envs_per_process": self.envs_per_process}
        return {name: value for name, value in given.items() if value is not None}

    def by_core(self) -> int:
        """Return how many envs share a process if there is one for each core."""
        return self.envs_per_process or -(-self.num_envs // CORES)


def sampled(space: Any, num_envs: int) -> Iterator[Any]:
    """Return an endless iterator over batches of sampled actions."""
    space.seed(0)
    batches = [
        np.stack([np.asarray(space.sample()) for _ in range(num_envs)]) for _ in range(NUM_ACTIONS)
    ]
    return cycle(batches)


@dataclass
class Stepped(Contender):
    """A contender whose steps are one blocking call that returns some results."""

    name: str
    work: Work

    packages: ClassVar[tuple[str, ...]] = ("gymnasium",)
    _envs: ClassVar[Any] = None

    @property
    def requires(self) -> tuple[str, ...]:
        return (*self.packages, *self.work.modules)

    def step(self) -> int:
        """Step; return the number of results."""
        raise NotImplementedError

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if self._envs is not None:
            self._envs.close()


# ---- groups of this library


def entry_of(work: Work) -> tuple[dict[str, Any], float]:
    """Return one config entry for all envs of `work`, and the limit of their episodes."""
    env = work.make()
    limit = env.spec.max_episode_steps
    env.close()
    # A name with a colon would otherwise be that of a function.
    backend = {"backend": "gymnasium"} if work.modules else {}
    entry = {"name": "bench", "task": work.task, "num_workers": work.num_envs, **backend}
    return {**entry, **work.fields()}, math.inf if limit is None else limit


@dataclass
class OursSync(Stepped):
    """`rlightning_aio.sync.EnvGroup`: all envs step, all results are awaited."""

    packages = ("rlightning_aio",)

    def setup(self) -> None:
        from rlightning_aio.sync import build_env_group

        entry, limit = entry_of(self.work)
        self._envs = build_env_group(entry)
        self._envs.init()
        self._envs.auto_reset(max_episode_steps=limit).__enter__()
        self._batch, _ = self._envs.reset(seed=0)
        self._actions = sampled(self._envs.get_action_spaces()[0], self.work.num_envs)

    def step(self) -> int:
        response = self._batch.respond(action=next(self._actions))
        self._batch, _ = self._envs.step(response)
        _ = self._batch.observation, self._batch.reward
        return self.work.num_envs


@dataclass
class OursAsync(Stepped):
    """`rlightning_aio.EnvGroup` on uvloop: ready envs are collected and stepped again.

    Attributes:
        min_results: of `collect_async`.
    """

    min_results: int = 1

    packages = ("rlightning_aio", "uvloop")
    _runner: ClassVar[Any] = None

    def setup(self) -> None:
        import asyncio

        import uvloop

        from rlightning_aio import build_env_group

        self._runner = asyncio.Runner(loop_factory=uvloop.new_event_loop)
        entry, limit = entry_of(self.work)
        self._envs = build_env_group(entry)
        self._runner.run(self._envs.init())
        self._envs.auto_reset(max_episode_steps=limit).__enter__()
        first, _ = self._runner.run(self._envs.reset(seed=0))
        self._actions = sampled(self._envs.get_action_spaces()[0], self.work.num_envs)
        self._send(first)

    def _send(self, batch: Any) -> None:
        self._envs.step_async(batch.respond(action=next(self._actions)[: len(batch)]))

    async def collect(self, seconds: float) -> int:
        """Collect and step for that long; return the number of results."""
        clock = time.perf_counter
        count = 0
        until = clock() + seconds
        while clock() < until:
            batch, _ = await self._envs.collect_async(min_results=self.min_results)
            _ = batch.observation, batch.reward
            self._send(batch)
            count += len(batch)
        return count

    async def measure(self, seconds: float) -> float:
        """Measure one round within the event loop."""
        await self.collect(0.1 * seconds)
        began = time.perf_counter()
        count = await self.collect(0.9 * seconds)
        return count / (time.perf_counter() - began)

    def round(self, seconds: float) -> float:
        return self._runner.run(self.measure(seconds))

    def teardown(self) -> None:
        if self._runner is not None:
            self._runner.run(self._envs.close())
            self._runner.close()


# ---- the interfaces of Gymnasium and Stable-Baselines3


@dataclass
class GymnasiumVector(Stepped):
    """A vector env of `gymnasium.make_vec`; without a mode, what it makes by default.

    `AsyncVectorEnv` has shared memory and one process for each env, `SyncVectorEnv` steps all envs
    in turn in the trainer's own process.
    """

    mode: str | None = None

    def make(self) -> Any:
        import gymnasium as gym

        if self.mode is None:
            return gym.make_vec(self.work.task, self.work.num_envs)
        if self.mode == "sync":
            return gym.vector.SyncVectorEnv(self.work.makers())
        return gym.vector.AsyncVectorEnv(self.work.makers(), shared_memory=True)

    def setup(self) -> None:
        self._envs = self.make()
        self._actions = sampled(self._envs.single_action_space, self.work.num_envs)
        self._envs.reset(seed=0)

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs


@dataclass
class OursVector(GymnasiumVector):
    """`rlightning_aio.vector.make_vec`; the mode ``async`` makes a `VectorEnv`, with workers.

    Time limits need workers, too, so the default has them only if it is a `VectorEnv` anyway.
    """

    packages = ("rlightning_aio",)

    def make(self) -> Any:
        from rlightning_aio.vector import VectorEnv, make_vec

        task, num_envs = self.work.task, self.work.num_envs
        if self.mode is None:
            made = make_vec(task, num_envs)
            if not isinstance(made, VectorEnv):
                return made
            made.close()
        return make_vec(task, num_envs, vectorization_mode=self.mode, **self.work.fields())


@dataclass
class Sb3Vector(Stepped):
    """`SubprocVecEnv` or `DummyVecEnv` of Stable-Baselines3."""

    kind: str = "SubprocVecEnv"

    packages = ("stable_baselines3",)

    def make(self) -> Any:
        from stable_baselines3.common import vec_env

        if self.kind == "DummyVecEnv":
            return vec_env.DummyVecEnv(self.work.makers())
        # By default each of its processes imports torch, which takes minutes in all; how fast
        # they step afterwards is the same.
        return vec_env.SubprocVecEnv(self.work.makers(), start_method="fork")

    def setup(self) -> None:
        self._envs = self.make()
        self._actions = sampled(self._envs.action_space, self.work.num_envs)
        self._envs.seed(0)
        self._envs.reset()

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs


@dataclass
class OursSb3(Sb3Vector):
    """`rlightning_aio.sb3.VecEnv`, with a worker for each core."""

    packages = ("rlightning_aio", "stable_baselines3")

    def make(self) -> Any:
        from rlightning_aio.sb3 import VecEnv

        fields = {**self.work.fields(), "envs_per_process": self.work.by_core()}
        return VecEnv(self.work.makers(), **fields)


# ---- other peers, which can hand out those that are ready first


@dataclass
class EnvPool(Stepped):
    """EnvPool: the same tasks rewritten in C++, stepped by its threads.

    Attributes:
        batch_size: results it hands out at a time; all envs if 0 (synchronous).
    """

    batch_size: int = 0

    packages = ("envpool",)

    def setup(self) -> None:
        import envpool

        self._envs = envpool.make(
            self.work.task.rpartition(":")[2].removeprefix("ALE/"),
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


def wrapped(work: Work) -> Any:
    """Make one env of `work`, as TorchRL has it."""
    from torchrl.envs import GymWrapper

    return GymWrapper(work.make(), categorical_action_encoding=True)


@dataclass
class TorchRL(Stepped):
    """`ParallelEnv` of TorchRL: a process for each env, reset in the step that ends an episode."""

    packages = ("torchrl",)

    def make(self) -> Any:
        from torchrl.envs import ParallelEnv

        makers = [partial(wrapped, self.work)] * self.work.num_envs
        return ParallelEnv(self.work.num_envs, makers, mp_start_method="fork")

    def setup(self) -> None:
        import torch
        import torchrl  # noqa: F401  It sets the start method when it is imported.

        # By default each of its processes imports torch, which takes minutes in all; their speed
        # afterwards is the same. Torch's threads don't survive a fork.
        torch.set_num_threads(1)
        mp.set_start_method("fork", force=True)
        single = self.work.make()
        self._actions = map(torch.as_tensor, sampled(single.action_space, self.work.num_envs))
        single.close()
        self._envs = self.make()
        self._state = self._envs.reset()
        self._state["action"] = next(self._actions)

    def step(self) -> int:
        _, self._state = self._envs.step_and_maybe_reset(self._state)
        self._state["action"] = next(self._actions)
        return self.work.num_envs

    def teardown(self) -> None:
        if self._envs is not None:
            self._envs.close(raise_if_closed=False)


@dataclass
class TorchRLPool(TorchRL):
    """`AsyncEnvPool` of processes with shared memory, in each a thread for each of its envs."""

    min_results: int = 1

    def make(self) -> Any:
        from torchrl.envs import AsyncEnvPool

        return AsyncEnvPool(
            [partial(wrapped, self.work)] * self.work.num_envs,
            backend="multiprocessing",
            exchange="shm",
            envs_per_worker=self.work.by_core(),
        )

    def setup(self) -> None:
        super().setup()
        self._envs.async_step_and_maybe_reset_send(self._state)

    def step(self) -> int:
        _, state = self._envs.async_step_and_maybe_reset_recv(min_get=self.min_results)
        count = len(state)
        state["action"] = next(self._actions)[:count]
        self._envs.async_step_and_maybe_reset_send(state)
        return count
