"""An env of several tasks whose outcome depends only on task and seed, and that fails at times.

Each file in the folder ``faults`` is one fault, named after its kind. Now and then a step removes a
file and has its fault, so the number of faults is known beforehand.
"""

from __future__ import annotations

import os
import random
import signal
import threading
import zlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

TASKS = ("reach", "push", "open", "turn")
KINDS = {
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "abort": os.abort,
    "hang": lambda: threading.Event().wait(),
    "exit": lambda: os._exit(3),
}


class Walk(gym.Env[Any, Any]):
    """A random walk of 3 to 40 steps; it succeeds if it ends above zero."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Discrete(2)
    switches_task = True

    def __init__(self, faults: str | None = None, share: float = 0.02) -> None:
        self._faults = None if faults is None else Path(faults)
        self._share = share
        self._task = TASKS[0]

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._task = (options or {}).get("task", self._task)
        if self._task not in TASKS:
            raise ValueError(f"no task {self._task!r}")
        self._rng = np.random.default_rng([zlib.crc32(self._task.encode()), seed or 0])
        self._left = int(self._rng.integers(3, 40))
        self._position = self._rng.normal(size=2)
        return self._position.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._faults is not None and random.random() < self._share:
            self._break(self._faults)
        self._left -= 1
        self._position += self._rng.normal(size=2) * (1 + int(action))
        reward = float(self._position[0])
        over = self._left == 0
        return self._position.copy(), reward, over, False, {"success": over and reward > 0}

    def _break(self, faults: Path) -> None:
        for fault in sorted(faults.iterdir()):
            try:
                fault.unlink()
            except FileNotFoundError:
                continue  # Another worker was faster.
            KINDS[fault.name.partition("-")[0]]()


def lay_faults(folder: Path, count: int) -> None:
    """Make `count` faults, the same number of each kind."""
    folder.mkdir()
    kinds = list(KINDS)
    for number in range(count):
        (folder / f"{kinds[number % len(kinds)]}-{number}").touch()


def policy(batch: Any) -> Any:
    """Return actions that depend on the observations."""
    return (batch.observation[:, 1] > 0).astype(np.int64)
