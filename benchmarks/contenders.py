"""The contenders that several questions share: this library, its peers, and the limit.

Rule: all contenders get the same single env from `gymnasium.make`, step it with actions sampled
beforehand, and reset finished episodes, each in its own way. They are measured by the results
handed to the trainer; where an env is reset in place of a step (Gymnasium, EnvPool, this library,
the in-process loops), that result counts as well.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import time
from dataclasses import dataclass, field
from importlib import import_module
from itertools import cycle
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from harness import Contender, throughput

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from multiprocessing.connection import Connection

# Number of batches of actions, sampled beforehand and used in turn.
NUM_ACTIONS = 64
# Steps between two readings of the clock, in loops where a reading would take noticeable time.
STEPS_PER_LOOK = 64


@dataclass(frozen=True)
class Work:
    """The workload.

    Attributes:
        task: Gymnasium id.
        num_envs: number of envs, for contenders that run several.
        modules: imported before the env is made.
        backend: this library's name for the simulator.
        max_episode_steps: limit for tasks without one.
        together: number of envs that this library steps with one request (its `num_envs`).
        placement: of this library's envs.
    """

    task: str
    num_envs: int
    modules: tuple[str, ...] = ()
    backend: str = "gymnasium"
    max_episode_steps: int | None = None
    together: int = 1
    placement: str = "process"

    @property
    def num_requests(self) -> int:
        """Return the number of requests for a step of all envs."""
        return self.num_envs // self.together

    def make(self) -> Any:
        """Return one env, as bare as `gymnasium.make` makes it."""
        import gymnasium as gym

        for module in self.modules:
            import_module(module)
        return gym.make(
            self.task, max_episode_steps=self.max_episode_steps, disable_env_checker=True
        )

    def episode_limit(self) -> int | None:
        """Return the number of steps after which an episode ends: its own or the
        registered limit.
        """
        import gymnasium as gym

        for module in self.modules:
            import_module(module)
        return self.max_episode_steps or gym.spec(self.task).max_episode_steps

    def makers(self) -> list[Callable[[], Any]]:
        return [self.make] * self.num_envs


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

    package = "gymnasium"
    _envs: ClassVar[Any] = None

    @property
    def requires(self) -> tuple[str, ...]:
        return (self.package, *self.work.modules)

    def step(self) -> int:
        """Step; return the number of results."""
        raise NotImplementedError

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        if self._envs is not None:
            self._envs.close()


# ---- this library


def group_config(work: Work, envs_per_process: int | str) -> dict[str, Any]:
    """Return one config entry for all envs of `work`."""
    from rlightning_aio.sharing import num_cores

    workers: dict[str, Any] = {}
    if work.placement != "inline":
        by_core = -(-work.num_requests // num_cores())  # `auto` gives own tasks a worker each.
        workers = {"envs_per_process": by_core if envs_per_process == "auto" else envs_per_process}
    return {
        "name": "bench",
        "backend": work.backend,
        "task": work.task,
        "num_workers": work.num_requests,
        "num_envs": work.together,
        "max_episode_steps": work.episode_limit(),
        "placement": work.placement,
        **workers,
        "imports": list(work.modules),
    }


def use_implementation(name: str) -> None:
    """Run the hot path by this implementation, in this process and its workers; "" is the usual."""
    if name:
        kernel = import_module("rlightning_aio.protocol.kernel")
        kernel.select(name)
        os.environ[kernel.VARIABLE] = name


@dataclass
class OursSync(Stepped):
    """`rlightning_aio.sync.EnvGroup`: all envs step, all results are awaited.

    Attributes:
        envs_per_process: as in a config entry; ``auto`` shares the envs by core.
        auto_reset: whether finished episodes are reset; not needed if episodes never end.
        implementation: of the hot path, see `use_implementation`.
    """

    envs_per_process: int | str = "auto"
    auto_reset: bool = True
    implementation: str = ""

    package = "rlightning_aio"

    def setup(self) -> None:
        from rlightning_aio.sync import build_env_group

        use_implementation(self.implementation)
        self._envs = build_env_group(group_config(self.work, self.envs_per_process))
        self._envs.init()
        if self.auto_reset:
            self._envs.auto_reset().__enter__()
        self._batch, _ = self._envs.reset(seed=0)
        self._actions = sampled(self._envs.get_action_spaces()[0], self.work.num_requests)

    def step(self) -> int:
        response = self._batch.respond(action=next(self._actions))
        self._batch, _ = self._envs.step(response)
        _ = self._batch.observation, self._batch.reward
        return self.work.num_envs


@dataclass
class OursAsync(Contender):
    """`rlightning_aio.EnvGroup`: ready envs are collected and stepped again.

    Attributes:
        envs_per_process, auto_reset, implementation: see `OursSync`.
        min_results, max_results: of `collect_async`.
        uvloop: run on uvloop rather than on asyncio's own loop.
    """

    name: str
    work: Work
    envs_per_process: int | str = "auto"
    auto_reset: bool = True
    min_results: int = 1
    max_results: int | None = None
    uvloop: bool = True
    implementation: str = ""

    _runner: ClassVar[Any] = None

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", *self.work.modules)

    def setup(self) -> None:
        import asyncio

        from rlightning_aio import build_env_group

        use_implementation(self.implementation)
        loop_factory = import_module("uvloop").new_event_loop if self.uvloop else None
        self._runner = asyncio.Runner(loop_factory=loop_factory)
        self._envs = build_env_group(group_config(self.work, self.envs_per_process))
        self._runner.run(self._envs.init())
        if self.auto_reset:
            self._envs.auto_reset().__enter__()
        self._first, _ = self._runner.run(self._envs.reset(seed=0))
        self._actions = sampled(self._envs.get_action_spaces()[0], self.work.num_requests)
        self.begin()

    def begin(self) -> None:
        """Step every env, so that there is something to collect."""
        self._send(self._first)

    def _send(self, batch: Any) -> None:
        self._envs.step_async(batch.respond(action=next(self._actions)[: len(batch)]))

    async def collect(self, seconds: float) -> int:
        """Collect and step for that long; return the number of results."""
        clock = time.perf_counter
        count = 0
        until = clock() + seconds
        while clock() < until:
            batch, _ = await self._envs.collect_async(
                min_results=self.min_results, max_results=self.max_results
            )
            _ = batch.observation, batch.reward
            self._send(batch)
            count += len(batch)
        return count * self.work.together

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


# ---- peers


@dataclass
class GymnasiumVector(Stepped):
    """A contender with Gymnasium's vector interface."""

    def make(self) -> Any:
        """Make all envs."""
        raise NotImplementedError

    def setup(self) -> None:
        self._envs = self.make()
        self._actions = sampled(self._envs.single_action_space, self.work.num_envs)
        self._envs.reset(seed=0)

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs


@dataclass
class GymnasiumAsync(GymnasiumVector):
    """`gymnasium.vector.AsyncVectorEnv` with shared memory: one process for each env."""

    def make(self) -> Any:
        from gymnasium.vector import AsyncVectorEnv

        return AsyncVectorEnv(self.work.makers(), shared_memory=True)


@dataclass
class GymnasiumSync(GymnasiumVector):
    """`gymnasium.vector.SyncVectorEnv`: all envs in turn, in the trainer's own process."""

    def make(self) -> Any:
        from gymnasium.vector import SyncVectorEnv

        return SyncVectorEnv(self.work.makers())


@dataclass
class Sb3Vector(Stepped):
    """A contender with Stable-Baselines3's vector interface."""

    package = "stable_baselines3"

    def make(self) -> Any:
        """Make all envs."""
        raise NotImplementedError

    def setup(self) -> None:
        self._envs = self.make()
        self._actions = sampled(self._envs.action_space, self.work.num_envs)
        self._envs.seed(0)
        self._envs.reset()

    def step(self) -> int:
        self._envs.step(next(self._actions))
        return self.work.num_envs


@dataclass
class StableBaselines3(Sb3Vector):
    """`SubprocVecEnv` of Stable-Baselines3: one process for each env, results pickled."""

    def make(self) -> Any:
        from stable_baselines3.common.vec_env import SubprocVecEnv

        # By default each of its processes imports torch, which takes minutes in all; how fast
        # they step afterwards is the same.
        return SubprocVecEnv(self.work.makers(), start_method="fork")


@dataclass
class Tianshou(Stepped):
    """`ShmemVectorEnv` of Tianshou: one process for each env; the user resets."""

    package = "tianshou"

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


@dataclass
class EnvPool(Stepped):
    """EnvPool: the same tasks rewritten in C++, stepped by its threads.

    Attributes:
        batch_size: results it hands out at a time; all envs if None (synchronous).
        thread_affinity_offset: the core to which its first thread is pinned; -1 for any.
    """

    batch_size: int | None = None
    thread_affinity_offset: int = -1

    package = "envpool"

    def setup(self) -> None:
        import envpool

        self._envs = envpool.make(
            self.work.task,
            env_type="gymnasium",
            num_envs=self.work.num_envs,
            batch_size=self.batch_size or self.work.num_envs,
            thread_affinity_offset=self.thread_affinity_offset,
            seed=0,
        )
        self._actions = sampled(self._envs.action_space, self.work.num_envs)
        self._envs.async_reset()

    def step(self) -> int:
        _, rewards, _, _, info = self._envs.recv()
        self._envs.send(next(self._actions)[: len(rewards)], info["env_id"])
        return len(rewards)


# ---- no runtime at all


class InLine:
    """Envs stepped one after the other in a plain loop; each is reset when its episode
    has ended.
    """

    def __init__(self, work: Work, num_envs: int, steps_per_look: int = STEPS_PER_LOOK) -> None:
        self._envs = [work.make() for _ in range(num_envs)]
        for seed, env in enumerate(self._envs):
            env.reset(seed=seed)
        batches = sampled(self._envs[0].action_space, num_envs)
        # Split like the output of a policy: Python numbers for Discrete, arrays for Box.
        self._actions = cycle(
            [
                [row.item() if row.ndim == 0 else row for row in np.array(next(batches))]
                for _ in range(NUM_ACTIONS)
            ]
        )
        self._ended = [False] * num_envs
        self._passes = max(1, steps_per_look // num_envs)

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
class InProcess(Stepped):
    """All envs in a plain loop of the trainer's own process."""

    def setup(self) -> None:
        self._envs = InLine(self.work, self.work.num_envs)

    def step(self) -> int:
        return self._envs.step()


@dataclass
class Limit(Contender):
    """Bare in-process loops around one env each, all running at once; nothing around them.

    Attributes:
        processes: number of processes; one for each core if None.
        num_envs: of each process, stepped in turn.
        steps_per_look: steps between two readings of the clock.
    """

    name: str
    work: Work
    processes: int | None = None
    num_envs: int = 1
    steps_per_look: int = STEPS_PER_LOOK

    @property
    def requires(self) -> tuple[str, ...]:
        return ("gymnasium", *self.work.modules)

    def setup(self) -> None:
        self._connections: list[Connection] = []
        self._processes: list[Any] = []
        context = mp.get_context("fork")
        for _ in range(self.processes or len(os.sched_getaffinity(0))):
            ours, theirs = context.Pipe()
            self._connections.append(ours)
            process = context.Process(target=self._loop, args=(theirs,))
            process.start()
            theirs.close()
            self._processes.append(process)
        for connection in self._connections:
            connection.recv()

    def _loop(self, connection: Connection) -> None:
        """Run in each process: one round for each number of seconds that is received."""
        for inherited in self._connections:
            inherited.close()
        envs = self.envs()
        connection.send(0.0)
        try:
            while True:
                connection.send(throughput(envs.step, connection.recv()))
        except EOFError:
            envs.close()

    def envs(self) -> Any:
        """Make the envs of each process."""
        return InLine(self.work, self.num_envs, self.steps_per_look)

    def round(self, seconds: float) -> float:
        for connection in self._connections:
            connection.send(seconds)
        return sum(connection.recv() for connection in self._connections)

    def teardown(self) -> None:
        for connection in self._connections:
            connection.close()
        for process in self._processes:
            process.join()


@dataclass
class BareBatch(Stepped):
    """Bare `mujoco.batch`: controls in, positions and velocities out; no rewards, no infos.

    A simulation whose body leaves the heights that its task calls healthy is put back to its first
    state, for one that lies on the ground takes up to twice as long a step.

    Attributes:
        half: half of the simulations are stepped at a time.
    """

    half: bool = False

    package = "mujoco.batch"

    def setup(self) -> None:
        import mujoco
        from mujoco.batch import Batch

        env, count = self.work.make(), self.work.num_envs
        model, data, size = env.unwrapped.model, env.unwrapped.data, mujoco.mjtState
        self._batch = Batch(model, count, len(os.sched_getaffinity(0)))
        for seed in range(count):
            env.reset(seed=seed)
            state = self._batch.state[seed]
            mujoco.mj_getState(model, data, state, size.mjSTATE_INTEGRATION)
        self._first = self._batch.state.copy()
        self._heights = getattr(env.unwrapped, "_healthy_z_range", None)
        # A planar body's first position is its x, and its second one its height.
        self._height = 1 if model.nq < 10 else 2
        self._fields = [self._batch.bind(name) for name in ("ctrl", "qpos", "qvel")]
        self._num_steps = env.unwrapped.frame_skip
        self._actions = sampled(env.action_space, count)
        halves = np.split(np.arange(count, dtype=np.int32), 2)
        self._ids = cycle(halves if self.half else [np.arange(count, dtype=np.int32)])

    def step(self) -> int:
        ids, (controls, *observed) = next(self._ids), self._fields
        controls[ids] = next(self._actions)[ids]
        self._batch.step(ids, nstep=self._num_steps)
        if self._heights is not None:
            low, high = self._heights
            heights = observed[0][:, self._height]
            fallen = np.flatnonzero((heights < low) | (heights > high))
            self._batch.state[fallen] = self._first[fallen]
        _ = np.concatenate([field[ids] for field in observed], axis=1)
        return len(ids)

    def teardown(self) -> None:
        """Do nothing: there is nothing to close."""


@dataclass
class MakeVec(GymnasiumVector):
    """`rlightning_aio.vector.make_vec`.

    Attributes:
        entry: its `vector_kwargs`.
        num_threads: of MuJoCo's; one per core if None.
    """

    entry: dict[str, Any] = field(default_factory=dict)
    num_threads: int | None = None

    package = "rlightning_aio"

    def make(self) -> Any:
        from rlightning_aio.vector import make_vec

        threads = {} if self.num_threads is None else {"num_threads": self.num_threads}
        return make_vec(self.work.task, self.work.num_envs, vector_kwargs=self.entry, **threads)


@dataclass
class VectorEntryPoint(GymnasiumVector):
    """The task's own vector environment, in the trainer's process."""

    def make(self) -> Any:
        import gymnasium as gym

        return gym.make_vec(
            self.work.task, self.work.num_envs, vectorization_mode="vector_entry_point"
        )
