"""How close is a group to a bare exchange over the same shared memory?

The bare exchange has only what a group can't omit: forked workers, one pinned to each core, arrays
that they share with the trainer, an eventfd in each direction, one copy in and one copy out. Its
envs are those of `gymnasium.make`. It has no request numbers, errors, infos, and deaths. Rounds of
contenders alternate in one run. The processor time per step and the context switches per batch of
all envs, both of all processes, are given in addition to the rate; they depend less on other work
on the machine. *Python twins* are the same group
without the compiled kernel, as after an installation without a C compiler.
"""

from __future__ import annotations

import json
import mmap
import os
import select
import signal
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from contenders import OursAsync, OursSync, Work
from harness import (
    Contender,
    Question,
    Target,
    arguments,
    machine_text,
    measure,
    tables,
    throughput,
)

CHEETAH = Work("HalfCheetah-v5", num_envs=32, backend="mujoco")
POLE = Work("CartPole-v1", num_envs=64)


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
        os.sched_setaffinity(
            0, {sorted(os.sched_getaffinity(0))[worker]}
        )  # Pinned like the group's workers.
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


def question(
    name: str,
    work: Work,
    pairs: list[tuple[Contender, Contender, float]],
    twins: list[Contender],
) -> Question:
    """Make the question of one work; `twins` run without the compiled kernel."""
    return Question(
        name=name,
        title=f"{work.task}, {work.num_envs} envs",
        unit="env steps/s",
        contenders=[*(contender for pair in pairs for contender in pair[:2]), *twins],
        targets=[Target(ours.name, bare.name, bound) for ours, bare, bound in pairs],
        rounds=7,
        seconds=1.5,
        batch=work.num_envs,
    )


QUESTIONS = (
    question(
        "exchange-cheetah",
        CHEETAH,
        [
            (OursSync("rlightning_aio sync", CHEETAH), Bare("bare exchange", CHEETAH), 0.95),
            (
                OursAsync("rlightning_aio async, 16 of 32", CHEETAH, min_results=16),
                Bare("bare exchange, 16 of 32", CHEETAH, min_workers=1),
                0.85,
            ),
        ],
        [
            OursSync("sync, Python twins", CHEETAH, implementation="python"),
            OursAsync(
                "async, 16 of 32, Python twins", CHEETAH, min_results=16, implementation="python"
            ),
        ],
    ),
    question(
        "exchange-pole",
        POLE,
        [(OursSync("rlightning_aio sync", POLE), Bare("bare exchange", POLE), 0.7)],
        [OursSync("sync, Python twins", POLE, implementation="python")],
    ),
)


def main() -> None:
    given = arguments(__doc__, QUESTIONS[0].rounds, QUESTIONS[0].seconds)
    reports = [measure(asked, given.rounds, given.seconds, given.only) for asked in QUESTIONS]
    shown = "\n\n".join(tables(report) for report in reports if report["results"])
    print(f"{shown}\n\n{machine_text(reports[0]['machine'])}")
    if given.json:
        whole = {
            **reports[0],
            "name": "exchange",
            "title": "A group and a bare exchange over the same shared memory",
            "results": {
                f"{name}, {report['title']}": found
                for report in reports
                for name, found in report["results"].items()
            },
            "targets": [
                {**target, "subject": f"{target['subject']}, {report['title']}"}
                for report in reports
                for target in report["targets"]
            ],
            "skipped": {name: why for report in reports for name, why in report["skipped"].items()},
            "tables": shown,
        }
        given.json.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
