"""EnvPool's C++ environments as a vector environment of Gymnasium; see docs/simulators.md."""

from typing import ClassVar

import envpool
import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from rlightning_aio.sync import build_env_group


class Pool(gym.vector.VectorEnv):
    # The step after the end of an episode resets.
    metadata: ClassVar = {"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}

    def __init__(self, task, num_envs, **options):
        self.num_envs = num_envs
        self.options = {"task_id": task, "num_envs": num_envs, "env_type": "gymnasium", **options}
        self.pool = envpool.make(**self.options)
        self.single_observation_space = self.pool.observation_space
        self.single_action_space = self.pool.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, **_):
        if seed is not None:  # A pool takes its seed when it is made.
            self.pool.close()
            self.pool = envpool.make(**self.options, seed=seed)
        return self.pool.reset()

    def step(self, actions):
        return self.pool.step(actions)

    def close_extras(self, **_):
        self.pool.close()


if __name__ == "__main__":
    rng = np.random.default_rng(0)
    entry = {"name": "pool", "task": Pool, "placement": "inline"}
    entry["env_kwargs"] = {"task": "CartPole-v1", "num_envs": 8}
    with build_env_group(entry) as group, group.auto_reset():
        batch, _ = group.reset(seed=0)
        for _ in range(100):
            actions = rng.integers(2, size=(1, 8))  # One env with eight sub-environments.
            batch, _ = group.step(batch.respond(action=actions))
            stored = batch.observation[~batch.is_reset], batch.reward[~batch.is_reset]
