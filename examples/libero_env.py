"""LIBERO's tasks as one env that switches between them; see docs/simulators.md."""

import gymnasium as gym
import numpy as np
from libero.libero import benchmark, get_libero_path
from libero.libero.envs import OffScreenRenderEnv

CAMERAS = ("agentview_image", "robot0_eye_in_hand_image")
STATE = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


class Libero(gym.Env):
    """Plays any task of a suite; ``init`` in the options is the number of the initial state."""

    switches_task = True
    action_space = gym.spaces.Box(-1, 1, (7,), np.float32)

    def __init__(self, suite="libero_spatial", size=256, settle=10):
        self.suite = benchmark.get_benchmark_dict()[suite]()
        self.numbers = {name: k for k, name in enumerate(self.suite.get_task_names())}
        self.size, self.settle, self.task, self.env = size, settle, None, None
        image = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        state = gym.spaces.Box(-np.inf, np.inf, (9,), np.float64)
        self.observation_space = gym.spaces.Dict({**dict.fromkeys(CAMERAS, image), "state": state})

    def reset(self, *, seed=None, options=None):
        options = {"task": next(iter(self.numbers)), **(options or {})}
        number = self.numbers[options["task"]]
        if options["task"] != self.task:
            self.close()
            task = self.suite.get_task(number)
            path = f"{get_libero_path('bddl_files')}/{task.problem_folder}/{task.bddl_file}"
            size = {"camera_heights": self.size, "camera_widths": self.size}
            self.env = OffScreenRenderEnv(bddl_file_name=path, **size)
            self.states = self.suite.get_task_init_states(number)
            self.task, self.text = options["task"], task.language
        self.env.seed(seed)
        self.env.reset()
        found = self.env.set_init_state(self.states[options.get("init", 0)])
        for _ in range(self.settle):  # Objects fall into place.
            found, *_ = self.env.step([0.0] * 6 + [-1.0])
        return self.observed(found), {"task": self.task, "task_description": self.text}

    def step(self, action):
        found, reward, done, _ = self.env.step(action.tolist())
        return self.observed(found), float(reward), bool(done), False, {"success": bool(done)}

    def observed(self, found):
        images = {name: np.ascontiguousarray(found[name][::-1, ::-1]) for name in CAMERAS}
        return {**images, "state": np.concatenate([found[name] for name in STATE])}

    def close(self):
        if self.env is not None:
            self.env.close()
