"""A plug-in of LeRobot: where it makes an `AsyncVectorEnv`, it makes a `VectorEnv` instead.

LeRobot imports the package because of its name, before it makes environments. All of LeRobot's
factories make the class that `gymnasium.vector` has under this name, and compare with it.
"""

from __future__ import annotations

import gymnasium as gym

from rlightning_aio.vector import VectorEnv

gym.vector.AsyncVectorEnv = VectorEnv
