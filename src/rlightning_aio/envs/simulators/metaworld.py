"""`metaworld`: the fifty tasks of MetaWorld, which share their envs."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from pydantic import BaseModel, ConfigDict

from rlightning_aio.envs.options import read_options
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.envs.simulators.switching import SwitchingEnv
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import did_you_mean

__all__ = ["MetaworldEnv", "MetaworldTask"]

_STATE = 39
_AGENT_POS = 4
"""The first numbers of the state: position of the hand, and how far the gripper is open."""


class _Options(BaseModel):
    """The fields of `env_kwargs`."""

    model_config = ConfigDict(extra="forbid")

    observations: Literal["state", "pixels"] = "state"
    terminate_on_success: bool = True
    render_mode: Literal["rgb_array"] | None = None
    camera_name: str = "corner2"
    width: int = 480
    height: int = 480


class MetaworldEnv(GymnasiumEnv):
    """One MetaWorld task at a time; a reset with ``options={"task": name}`` switches to another.

    The seed of a reset determines where objects and goal are.
    """

    def _make(self) -> Any:
        options = read_options(_Options, self.env_id, self.config.env_kwargs)
        if options.observations == "pixels":
            options.render_mode = "rgb_array"
        env: Any = SwitchingEnv(
            partial(MetaworldTask, options=options), self.config.task_name, _space(options)
        )
        limit = self.config.max_episode_steps
        if limit is not None:
            return TimeLimit(env, limit)
        # MetaWorld's own, which is the same for all tasks.
        self.max_episode_steps = int(env.env.max_path_length)
        return env


def _space(options: _Options) -> gym.Space[Any]:
    """Return a space that holds the observations of all tasks."""
    if options.observations == "state":
        return gym.spaces.Box(-np.inf, np.inf, (_STATE,), np.float64)
    shape = (options.height, options.width, 3)
    return gym.spaces.Dict(
        {
            "pixels": gym.spaces.Box(0, 255, shape, np.uint8),
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (_AGENT_POS,), np.float64),
        }
    )


class MetaworldTask(gym.Env[Any, Any]):
    """One task, with the goal in its observations, placed at random by the seed of each reset.

    Args:
        task: a name such as ``reach-v3``.
        options: what is observed, when an episode ends, and how frames are rendered.

    Raises:
        ConfigError: there is no such task.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 80}  # noqa: RUF012  # Gymnasium's.

    def __init__(self, task: str, options: _Options) -> None:
        kinds: dict[str, Any] = importlib.import_module("metaworld.env_dict").ALL_V3_ENVIRONMENTS
        if task not in kinds:
            hint = did_you_mean(task, kinds)
            raise ConfigError(f"MetaWorld has no task {task!r}{hint and f'; {hint}'}")
        self._pixels = options.observations == "pixels"
        self._terminates = options.terminate_on_success
        self.render_mode = options.render_mode
        size: dict[str, Any] = {"width": options.width, "height": options.height}
        if options.render_mode is not None:
            size["camera_name"] = options.camera_name
        self._simulator: Any
        simulator = self._simulator = kinds[task](render_mode=options.render_mode, **size)
        self._is_turned = options.render_mode is not None and options.camera_name == "corner2"
        if self._is_turned:
            # As LeRobot places it; MetaWorld's own place shows the robot from farther away.
            simulator.model.cam_pos[2] = [0.75, 0.075, 0.7]
        simulator._partially_observable = False
        # Steps clip to this space, which would hide the goal; it is computed again.
        simulator.__dict__.pop("sawyer_observation_space", None)
        simulator._set_task_called = simulator.seeded_rand_vec = True
        self.max_path_length: int = simulator.max_path_length
        self.observation_space = _space(options)
        self.action_space = simulator.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Place objects and goal, and begin an episode."""
        del options
        super().reset(seed=seed)
        simulator = self._simulator
        simulator.seed(int(self.np_random.integers(2**31)) if seed is None else seed)
        # A reset sets everything up twice, and draws places each time, which must agree. So they
        # are drawn before it, and kept.
        simulator._freeze_rand_vec = False
        simulator.reset_model()
        simulator._freeze_rand_vec = True
        state, _ = simulator.reset()
        return self._observed(state), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the simulator; the episode ends at success, unless it was made without that."""
        state, reward, _, truncated, info = self._simulator.step(action)
        terminated = self._terminates and bool(info["success"])
        return self._observed(state), float(reward), terminated, truncated, info

    def _observed(self, state: Any) -> Any:
        if self._pixels:
            return {"pixels": self.render(), "agent_pos": state[:_AGENT_POS]}
        return state

    def render(self) -> Any:
        """Return a frame, the right way up."""
        frame = self._simulator.render()
        # This camera of MetaWorld's is upside down.
        return np.ascontiguousarray(frame[::-1, ::-1]) if self._is_turned else frame

    def close(self) -> None:
        self._simulator.close()
