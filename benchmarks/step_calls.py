"""How many Python calls does the trainer make for one step? Exact on any machine.

`sys.setprofile` counts each entry into a Python function, including resumed generators, but no
calls into C. Workers sleep and are stopped before each step, and continue when the trainer waits.
So every step wakes them, and waits once in at least one round, on any machine. Spinning is switched
off. Work that is done only once is done before the counted steps.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import gymnasium as gym
import numpy as np

import rlightning_aio
from rlightning_aio.collecting import Collector
from rlightning_aio.protocol.exchange import WORKER_ASLEEP
from rlightning_aio.sync import build_env_group
from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import CodeType, FrameType

NUM_ENVS = 8
ROUNDS = 40
CARTPOLE = {
    "name": "pole",
    "backend": "gymnasium",
    "task": "CartPole-v1",
    "num_workers": NUM_ENVS,
    "envs_per_process": NUM_ENVS // 2,
}
LIMITS = {"step_timeout": None}


@dataclass
class Calls:
    """The number of calls of each function between `start` and `stop`."""

    of: Counter[CodeType] = field(default_factory=Counter)

    def start(self) -> None:
        sys.setprofile(self._note)

    def stop(self) -> None:
        sys.setprofile(None)

    def _note(self, frame: FrameType, event: str, argument: Any) -> None:
        del argument
        if event == "call" and frame.f_code.co_filename != __file__:
            self.of[frame.f_code] += 1

    def figures(self) -> dict[str, int]:
        return {
            "calls": self.of.total(),
            "functions": len(self.of),
            # Functions that `dataclasses` and the import system make are in no file.
            "files": len({code.co_filename for code in self.of if code.co_filename[0] != "<"}),
        }

    def listed(self) -> str:
        """Return each function with its calls, by file."""
        lines = sorted(
            (Path(code.co_filename).name, code.co_firstlineno, code.co_qualname, count)
            for code, count in self.of.items()
        )
        return "\n".join(f"  {count:4} {name}:{line} {what}" for name, line, what, count in lines)


def fewest_of(found: list[Calls]) -> Calls:
    """Return the calls of the round with the fewest, of the second half of all.

    Workers that continue may be late, on a machine with other work, and are then waited for once
    more; one that isn't held may be as well.
    """
    return min(found[len(found) // 2 :], key=lambda calls: calls.of.total())


class Held:
    """The workers of a group, stopped until the trainer waits."""

    def __init__(self, group: Any) -> None:
        core = vars(group)["_core"]
        self._rings = core.tables.requests.rings
        vars(core.waiting)["_poller"].num_cores = 0
        self._pids = [worker["pid"] for worker in group.get_workers()]
        self._driver = vars(vars(group)["_driver"])
        self._epoll = self._driver.get("_epoll")

    def __enter__(self) -> Self:
        if self._epoll is not None:
            self._driver["_epoll"] = self
        return self

    def __exit__(self, *error: object) -> None:
        self.release()
        if self._epoll is not None:
            self._driver["_epoll"] = self._epoll

    def hold(self) -> None:
        while not all(ring.words[WORKER_ASLEEP] for ring in self._rings):
            time.sleep(0)
        for pid in self._pids:
            os.kill(pid, signal.SIGSTOP)

    def release(self) -> None:
        for pid in self._pids:
            os.kill(pid, signal.SIGCONT)

    def poll(self, timeout: float) -> Any:
        self.release()
        return self._epoll.poll(timeout)


def counted(group: Any, call: Callable[[], Any]) -> Calls:
    """Return the calls of one `call`, which sends steps and waits for their results."""
    found: list[Calls] = []
    with Held(group) as held:
        for _ in range(ROUNDS):
            held.hold()
            calls = Calls()
            calls.start()
            try:
                call()
            finally:
                calls.stop()
            found.append(calls)
    return fewest_of(found)


def step() -> Calls:
    """Count `step` of the synchronous group."""
    with build_env_group(CARTPOLE) as group, group.auto_reset():
        batch, _ = group.reset(seed=0)
        actions = np.zeros(NUM_ENVS, np.int64)

        def call() -> None:
            nonlocal batch
            batch, _ = group.step(batch.respond(action=actions))

        return counted(group, call)


def step_and_collect_async() -> Calls:
    """Count `step_async` and `collect_async` on an event loop (uvloop's)."""

    async def main() -> Calls:
        async with rlightning_aio.build_env_group(CARTPOLE) as group:
            with group.auto_reset():
                batch, _ = await group.reset(seed=0)
                held = Held(group)
                actions = np.zeros(NUM_ENVS, np.int64)
                found: list[Calls] = []
                for _ in range(ROUNDS):
                    held.hold()
                    asyncio.get_running_loop().call_soon(held.release)
                    calls = Calls()
                    calls.start()
                    group.step_async(batch.respond(action=actions))
                    batch, _ = await group.collect_async(wait_all=True)
                    calls.stop()
                    found.append(calls)
                return fewest_of(found)

    # In a separate task, because `uvloop.run` wraps the main one.
    async def apart() -> Calls:
        return await asyncio.create_task(main())

    return rlightning_aio.run(apart())


def vector_step() -> Calls:
    """Count `VectorEnv.step`."""
    makers = [lambda: gym.make("CartPole-v1")] * NUM_ENVS
    env = VectorEnv(makers, envs_per_process=NUM_ENVS // 2, **LIMITS)
    env.reset(seed=0)
    actions = np.zeros(NUM_ENVS, np.int64)
    try:
        return counted(env.group, lambda: env.step(actions))
    finally:
        env.close()


def collect_16() -> Calls:
    """Count `Collector.collect` of 16 transitions."""

    def policy(batch: Any) -> dict[str, Any]:
        return {"action": np.zeros(len(batch), np.int64)}

    with build_env_group(CARTPOLE) as group, group.auto_reset():
        collector = Collector(group, policy, num_transitions=16, min_results=NUM_ENVS, seed=0)
        collector.collect()
        # It steps twice; workers are held only before the first.
        return counted(group, collector.collect)


MEASURED = {
    "step": step,
    "step_async and collect_async": step_and_collect_async,
    "VectorEnv.step": vector_step,
    "Collector.collect, 16 transitions": collect_16,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--list", action="store_true", help="also list each function")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--step-timeout", type=float, help="of the envs, in seconds")
    given = parser.parse_args()
    LIMITS["step_timeout"] = CARTPOLE["step_timeout"] = given.step_timeout
    found = {name: measure() for name, measure in MEASURED.items()}
    if given.json:
        print(json.dumps({name: calls.figures() for name, calls in found.items()}))
        return
    for name, calls in found.items():
        print(f"{name:36}", *(f"{count:5} {what}" for what, count in calls.figures().items()))
        if given.list:
            print(calls.listed())


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
