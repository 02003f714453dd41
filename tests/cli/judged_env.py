"""An env that judges its episodes, and can be filmed."""

from __future__ import annotations

import sys
import threading
from typing import Any

import gymnasium as gym
import numpy as np
from kit.scripted import Counts


class Judged(Counts):
    """Succeeds if the seed of the episode is even; an episode has three steps."""

    action_space = gym.spaces.Discrete(2)
    render_mode = "rgb_array"
    length, last_seed = 3, 0

    def told(self) -> dict[str, Any]:
        self.last_seed = self.last_seed if self.seed is None else self.seed
        return {"success": self.last_seed % 2 == 0} if self.steps else {}

    def render(self) -> Any:
        return np.full((16, 16, 3), 50 * self.steps, np.uint8)


class Waiting(Judged):
    """Goes no further than the first step of the second episode; another one than the first
    doesn't even begin.
    """

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if (self.seed == 2 and self.steps == 1) or self.seed % 2:
            if self.seed == 2:
                sys.stderr.write("waits\n")
                sys.stderr.flush()
            threading.Event().wait()
        return super().step(action)


class Rewarded(Judged):
    """Gives the same reward, of any value, for each step of an episode."""

    def __init__(self, reward: str) -> None:
        self.reward = float(reward)

    def does(self, action: Any) -> float:
        return self.reward


class Switching(Judged):
    """Plays any task, and raises in one."""

    switches_task = True

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if options and options["task"] == "raises":
            raise ValueError("as its task says")
        return super().reset(seed=seed)
