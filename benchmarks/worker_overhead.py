"""What does a worker add to the step of an env, with the compiled kernel and with its Python twins?

Rings and rows of a worker lie in this process, which takes both sides in turn: 16 envs are stepped
through `Worker.run_requests`, and then by bare calls. The difference, by step, is the overhead;
rounds of the two implementations alternate. Where other processes use the caches it is larger.
"""

from __future__ import annotations

import argparse
import socket
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import no_work
import numpy as np

from rlightning_aio._core.hosts.process.worker import Worker
from rlightning_aio._core.hosts.running.runner import EnvRunner
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.slab import Slab

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))
from protocol.memory_of_rings import both_sides

NUM_ENVS = 16


class Served:
    """Envs of one worker, and the trainer's side of its rings."""

    def __init__(self, task: str, implementation: str) -> None:
        kernel.select(implementation)
        config = EnvConfig(name="e", backend="gymnasium", task=task, num_workers=NUM_ENVS)
        runners = [EnvRunner(GymnasiumEnv(config, k)) for k in range(NUM_ENVS)]
        layout = runners[0].layout
        slab = Slab(layout, memoryview(bytearray(layout.size(NUM_ENVS))), NUM_ENVS)
        for row, runner in enumerate(runners):
            runner.attach(slab, row, lambda _: 1)
        self.steps: list[Any] = [runner.env.env.step for runner in runners]
        self.actions = slab.action
        _, self.trainer, rings = both_sides(NUM_ENVS)
        self.channel, theirs = socket.socketpair()
        self.worker = Worker(theirs, -1, rings, 0)
        # As a worker has them after its start.
        vars(self.worker).update(_runners=runners, _steps=[runner.step for runner in runners])
        self.number = 0
        self.served(Operation.RESET)

    def served(self, op: Operation) -> int:
        """Return the ns of one request to each env."""
        self.number += 1
        self.trainer.request(np.array([entry(self.number, k, op) for k in range(NUM_ENVS)]))
        began = time.perf_counter_ns()
        self.worker.run_requests()
        taken = time.perf_counter_ns() - began
        assert len(self.trainer.reports()) == NUM_ENVS
        return taken

    def bare(self) -> int:
        """Return the ns of one bare step of each env."""
        began = time.perf_counter_ns()
        for step, action in zip(self.steps, self.actions, strict=True):
            step(action)
        return time.perf_counter_ns() - began


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=300, help="default: %(default)s")
    rounds = parser.parse_args().rounds
    names = ["python", *(["c"] if kernel.compiled() else [])]
    for task in (no_work.NO_WORK, "HalfCheetah-v5"):
        served = {name: Served(task, name) for name in names}
        overhead: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(rounds):
            for name, envs in served.items():
                kernel.select(name)
                envs.bare()  # The caches hold the other envs.
                taken = envs.served(Operation.STEP) - envs.bare()
                overhead[name].append(taken / NUM_ENVS / 1e3)
        for name, values in overhead.items():
            print(f"{task:22} {name:7} {statistics.median(values):5.2f} µs by step")


if __name__ == "__main__":
    main()
