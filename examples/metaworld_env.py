"""MetaWorld's tasks as one env that switches between them, and its scripted policies.

The config names ``metaworld_env:MetaWorld`` and the command ``--policy metaworld_env:scripted``, in
the folder of this file; docs/simulators.md has both.
"""

from typing import ClassVar

import gymnasium as gym
import metaworld  # noqa: F401 - it registers the environments
import numpy as np
from metaworld.policies import ENV_POLICY_MAP

playing = {}


class MetaWorld(gym.Env):
    """Plays any of the 50 tasks: a reset names it, and its seed chooses one of 50 goals."""

    switches_task = True
    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 80}
    observation_space = gym.spaces.Box(-np.inf, np.inf, (39,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (4,), np.float32)

    def __init__(self, **kwargs):
        self.kwargs = {"terminate_on_success": True, "disable_env_checker": True, **kwargs}
        self.render_mode, self.task, self.env = kwargs.get("render_mode"), None, None

    def reset(self, *, seed=None, options=None):
        task = (options or {}).get("task", self.task or "reach-v3")
        if task != self.task:
            self.close()
            self.env = gym.make("Meta-World/MT1", env_name=task, seed=0, **self.kwargs)
            self.task = task
        if seed is not None:
            self.env.unwrapped.seed(seed)  # Its own reset ignores seeds.
        observation, info = self.env.reset()
        return observation, {**info, "task": task}

    def step(self, action):
        return self.env.step(action)

    def render(self):
        return self.env.render()

    def close(self):
        if self.env is not None:
            self.env.close()


def scripted(batch):
    """Take the place of your policy."""
    begins = np.flatnonzero(batch.is_reset).tolist()
    if begins:  # An episode begins: the info of its reset names the task.
        started = batch.take(begins)
        for env_id, info in zip(started.env_ids(), started.info(), strict=True):
            playing[env_id] = ENV_POLICY_MAP[info["task"]]()
    actions = [
        playing[env_id].get_action(observation)
        for env_id, observation in zip(batch.env_ids(), batch.observation, strict=True)
    ]
    return np.clip(actions, -1, 1).astype(np.float32)
