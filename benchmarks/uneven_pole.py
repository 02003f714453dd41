"""CartPole with uneven step times, like those of a simulator with contacts or of a robot.

The id for `gymnasium.make` and config entries is ``uneven_pole:benchmarks/UnevenCartPole-v0``,
which imports this module where the environment is made.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium as gym

UNEVEN = "uneven_pole:benchmarks/UnevenCartPole-v0"


class Uneven(gym.Wrapper[Any, Any, Any, Any]):
    """Sleeps in each step for a log-normal time: median 5 ms, sigma 1, cut to 2 to 30 ms.

    The mean is 7.7 ms, and of 32 that step at once the slowest takes 28 ms.
    """

    MEDIAN, SIGMA, LEAST, MOST = 5e-3, 1.0, 2e-3, 30e-3

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        seconds = self.MEDIAN * self.np_random.lognormal(0.0, self.SIGMA)
        time.sleep(min(max(seconds, self.LEAST), self.MOST))
        return self.env.step(action)


def _made(**kwargs: Any) -> gym.Env[Any, Any]:
    return Uneven(gym.make("CartPole-v1", **kwargs))


gym.register(UNEVEN.partition(":")[2], _made, disable_env_checker=True, order_enforce=False)
