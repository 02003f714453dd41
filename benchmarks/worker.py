"""HalfCheetah and Humanoid: what do a worker's loop and the turns of its envs cost a step?

The limit steps one env over and over, which then has the caches to itself; a worker steps
several in turn. So beside the loop that runs in workers (rings, rows, infos, times; no
trainer, no waiting) there is a bare loop over as many envs. One process each, on one core.
"""

from __future__ import annotations

import gc
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from contenders import Limit, Stepped, Work, group_config, sampled
from harness import Question, Target, main

if TYPE_CHECKING:
    from collections.abc import Iterator

CHEETAHS = Work("HalfCheetah-v5", num_envs=16, backend="mujoco")
HUMANOIDS = Work("Humanoid-v5", num_envs=8, backend="mujoco")


class Nobody:
    """In place of the channel to a trainer: infos' schemas are sent there once."""

    def sendall(self, data: bytes) -> None: ...


@dataclass
class WorkerLoop(Stepped):
    """A worker's loop in this process; requests are laid into its ring by hand."""

    package = "rlightning_aio"

    def setup(self) -> None:
        from rlightning_aio.config import EnvConfig
        from rlightning_aio.hosts.build_env import build_env
        from rlightning_aio.hosts.runner import EnvRunner
        from rlightning_aio.hosts.worker import Worker
        from rlightning_aio.protocol import bell, entries, rings
        from rlightning_aio.protocol.slab import Slab

        count = self.work.num_envs
        config = EnvConfig(**group_config(self.work, count))
        runners = [EnvRunner(build_env(config, worker_index=k)) for k in range(count)]
        layout = runners[0].layout
        self._slab = Slab(layout, memoryview(bytearray(layout.size(count))), count)
        memory = memoryview(bytearray(rings.rings_size(count)))
        channel: Any = Nobody()
        bell_memory = memoryview(bytearray(bell.bell_size(1)))
        worker_rings = rings.WorkerRings(memory, count, bell.WorkerBell(bell_memory, 1, 0))
        self._worker = Worker(channel, 0, worker_rings, 0)
        self._worker.adopt(runners, [(self._slab, row) for row in range(count)])
        gc.collect()
        gc.freeze()  # As workers do.
        self._trainer = rings.TrainerRings(memory, count, bell.TrainerBell(bell_memory, 1), 0)
        reset = entries.Operation.RESET
        self._entries = np.array([entries.entry(0, row, reset) for row in range(count)])
        self._next = 1 << entries.NUMBER_SHIFT
        self._actions: Iterator[Any] = sampled(layout.action_space, count)
        self._ended = np.ones(count, bool)

    def step(self) -> int:
        from rlightning_aio.protocol.entries import OP_MASK, Operation

        self._slab.action[:] = next(self._actions)
        self._entries = (self._entries & ~OP_MASK) + self._next + Operation.STEP + self._ended
        self._trainer.request(self._entries)
        self._worker.run_requests()
        self._trainer.reports()
        self._ended = self._slab.over.copy()
        return len(self._entries)

    def teardown(self) -> None:
        """There is nothing to close."""


def turns(work: Work) -> str:
    return f"{work.task}, {work.num_envs} in turn, bare"


def served(work: Work) -> str:
    return f"{work.task}, {work.num_envs} in turn, a worker's loop"


def alone(work: Work) -> str:
    return f"{work.task}, one, bare"


QUESTION = Question(
    name="worker",
    title="One process",
    unit="env steps/s",
    contenders=[
        contender
        for work in (CHEETAHS, HUMANOIDS)
        for contender in (
            Limit(alone(work), work, processes=1),
            Limit(turns(work), work, processes=1, num_envs=work.num_envs),
            WorkerLoop(served(work), work),
        )
    ],
    targets=[Target(served(work), turns(work), 0.9) for work in (CHEETAHS, HUMANOIDS)],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
