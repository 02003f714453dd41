"""How close is a group to a bare exchange over the same shared memory?

The bare exchange has only what a group can't omit: forked workers, one pinned to each core, arrays
that they share with the trainer, an eventfd in each direction, one copy in and one copy out. Its
envs are those of `gymnasium.make`. It has no request numbers, errors, infos, limits and deaths.
Rounds of contenders alternate in one run. The processor time of all processes for a step is given
in addition to the rate; it depends less on other work on the machine. Groups have time limits.
`RLIGHTNING_AIO_IMPL=python` in the environment measures them without the compiled kernel.
"""

from __future__ import annotations

import mmap
import os
import select
import signal
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from contenders import CORES, OursAsync, OursSync, Work
from harness import STEPS, Contender, Question, Target, main, throughput

CHEETAH, POLE = Work("HalfCheetah-v5", 32), Work("CartPole-v1", 64)
OWN = Work("own_envs:benchmarks/Own20-v0", 32, envs_per_process=-(-32 // CORES))


@dataclass
class Bare(Contender):
    """The bare exchange; if `min_workers` is below all, ready workers are stepped again."""

    name: str
    work: Work
    min_workers: int = 0
    pids: list[int] = field(default_factory=list)

    def setup(self) -> None:
        count = len(os.sched_getaffinity(0))
        self.each = self.work.num_envs // count
        env = gym.make(self.work.task, disable_env_checker=True)
        observation, action = env.observation_space, env.action_space
        assert observation.shape is not None
        assert action.shape is not None
        self.observations = shared((self.work.num_envs, *observation.shape), observation.dtype)
        self.results = shared((self.work.num_envs, 3), np.float64)  # Reward and both ends.
        self.actions = shared((self.work.num_envs, *action.shape), action.dtype)
        samples = [[action.sample() for _ in range(self.work.num_envs)] for _ in range(64)]
        self.samples = np.array(samples, action.dtype)
        self.ask = [os.eventfd(0) for _ in range(count)]
        self.done = [os.eventfd(0) for _ in range(count)]
        for worker in range(count):
            self.pids.append(os.fork())
            if not self.pids[-1]:
                try:
                    self.serve(worker)
                finally:
                    os._exit(1)
        self.poll = select.epoll()
        for done in self.done:
            self.poll.register(done, select.EPOLLIN)
        self.turn = 0
        for worker in range(count):
            self.send(worker)

    def serve(self, worker: int) -> None:
        os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[worker]})
        first = worker * self.each
        rows = range(first, first + self.each)
        envs = [gym.make(self.work.task, disable_env_checker=True) for _ in rows]
        for row, env in zip(rows, envs, strict=True):
            self.observations[row] = env.reset(seed=row)[0]
        over = [False] * self.each
        while True:
            os.eventfd_read(self.ask[worker])
            for k, (row, env) in enumerate(zip(rows, envs, strict=True)):
                if over[k]:
                    self.observations[row], over[k] = env.reset()[0], False
                    continue
                observation, reward, terminated, truncated, _ = env.step(self.actions[row].copy())
                self.observations[row] = observation
                self.results[row] = reward, terminated, truncated
                over[k] = terminated or truncated
            os.eventfd_write(self.done[worker], 1)

    def send(self, worker: int) -> None:
        rows = slice(worker * self.each, (worker + 1) * self.each)
        self.turn += 1
        self.actions[rows] = self.samples[self.turn % 64][rows]
        os.eventfd_write(self.ask[worker], 1)

    def step(self) -> int:
        """Wait for workers, copy their results, and step them again."""
        ready: list[int] = []
        while len(ready) < (self.min_workers or len(self.done)):
            for descriptor, _ in self.poll.poll():
                os.eventfd_read(descriptor)
                ready.append(self.done.index(descriptor))
        for worker in ready:
            rows = slice(worker * self.each, (worker + 1) * self.each)
            _ = self.observations[rows].copy(), self.results[rows].copy()
        for worker in ready:
            self.send(worker)
        return len(ready) * self.each

    def round(self, seconds: float) -> float:
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        for pid in self.pids:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def shared(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return an array that forked processes share."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(mmap.mmap(-1, max(size, 1)), dtype)[: int(np.prod(shape))].reshape(shape)


SYNC, HALF, BARE = "rlightning_aio sync", "rlightning_aio async, 16 of 32", "bare exchange"
QUESTIONS = (
    Question(
        "exchange",
        "HalfCheetah-v5, 32 envs",
        STEPS,
        [
            OursSync(SYNC, CHEETAH),
            Bare(BARE, CHEETAH),
            OursAsync(HALF, CHEETAH, 16),
            Bare(f"{BARE}, 16 of 32", CHEETAH, min_workers=1),
        ],
        [Target(SYNC, BARE, 0.9), Target(HALF, f"{BARE}, 16 of 32", 0.85)],
    ),
    *(
        Question("exchange", title, STEPS, [OursSync(SYNC, work), Bare(BARE, work)],
                 [Target(SYNC, BARE, 0.9)])
        for title, work in (("CartPole-v1, 64 envs", POLE), ("own envs of 20 µs, 32 envs", OWN))
    ),
)  # fmt: skip


if __name__ == "__main__":
    main(QUESTIONS, __doc__)
