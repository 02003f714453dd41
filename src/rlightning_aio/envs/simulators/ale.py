"""`ale`: Atari games of the Arcade Learning Environment, one at a time or vectorised.

Rule: a config means the same game, frames and rewards whether ``num_envs`` is 1 (ALE's Gymnasium
env) or more (ale-py's C++ vector environment).
Absent on purpose: our own preprocessing, and ale-py's asynchronous mode, because several workers
do the same.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation, TimeLimit
from gymnasium.wrappers.vector import TransformObservation

from rlightning_aio.envs.ale_console import StickyConsole, is_sticky
from rlightning_aio.envs.base import sub_env_seeds
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from rlightning_aio.types import EnvRet

# Optional and untyped, so imported by name; importing it registers the games.
ale_py: Any = import_module("ale_py")
# Otherwise each game that starts prints a banner.
ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)

# Defaults of `AtariPreprocessing`.
PREPROCESSING_DEFAULTS: dict[str, Any] = {
    "noop_max": 30,
    "frame_skip": 4,
    "screen_size": 84,
    "terminal_on_life_loss": False,
    "grayscale_obs": True,
    "grayscale_newaxis": False,
    "scale_obs": False,
}
SINGLE_GAME_ONLY = ("grayscale_newaxis", "scale_obs")


class ALEEnv(GymnasiumEnv):
    """One Atari game, or ``num_envs`` of them in ale-py's vector environment.

    ``env_kwargs`` may have ``preprocessing`` (true, or a mapping of options of Gymnasium's
    `AtariPreprocessing`) and ``frame_stack`` (number of frames in an observation, oldest first);
    all others go to `gymnasium.make` or `gymnasium.make_vec`.

    Observations are uint8: raw ``[210, 160, 3]``, preprocessed ``[84, 84]``, with leading axes for
    ``num_envs`` and ``frame_stack`` if these are above 1. A vectorised game that has ended is reset
    by the next step, which ignores its action and returns reward 0.
    """

    _is_seeded = False

    def _make(self) -> Any:
        game_kwargs = dict(self.config.env_kwargs)
        preprocessing = self._preprocessing_options(game_kwargs.pop("preprocessing", False))
        frame_stack = int(game_kwargs.pop("frame_stack", 1))
        make = self._make_games if self.num_envs > 1 else self._make_game
        return make(preprocessing, frame_stack, game_kwargs)

    def _preprocessing_options(self, given: Any) -> dict[str, Any] | None:
        """Options of the preprocessing, completed; None for raw frames."""
        if given is False or given is None:
            return None
        options: dict[str, Any] = {} if given is True else dict(given)
        allowed = set(PREPROCESSING_DEFAULTS)
        if self.num_envs > 1:
            allowed -= set(SINGLE_GAME_ONLY)
        if unknown := sorted(set(options) - allowed):
            raise ConfigError(
                f"env {self.env_id!r}: env_kwargs.preprocessing has no {', '.join(unknown)} "
                f"with num_envs: {self.num_envs}; it takes true, or {', '.join(sorted(allowed))}"
            )
        options = PREPROCESSING_DEFAULTS | options
        size: Any = options["screen_size"]
        # YAML has no tuples, which the wrapper requires.
        options["screen_size"] = (size, size) if isinstance(size, int) else tuple(size)
        return options

    def _make_game(
        self, preprocessing: dict[str, Any] | None, frame_stack: int, game_kwargs: dict[str, Any]
    ) -> gym.Env[Any, Any]:
        if preprocessing is not None:
            # The preprocessing skips frames, and needs the skipped ones.
            game_kwargs = {"frameskip": 1, **game_kwargs}
        game_kwargs = {"disable_env_checker": True, **game_kwargs}
        env: gym.Env[Any, Any] = gym.make(self.config.task_name, **game_kwargs)
        game: Any = env.unwrapped
        if is_sticky(game.ale):
            game.ale = StickyConsole(game.ale)
        if preprocessing is not None:
            env = AtariPreprocessing(env, **preprocessing)
        if frame_stack > 1:
            env = FrameStackObservation(env, frame_stack)
        if self.config.max_episode_steps is not None:
            # Outermost, because inside the preprocessing it would count frames.
            env = TimeLimit(env, self.config.max_episode_steps)
        return env

    def _make_games(
        self, preprocessing: dict[str, Any] | None, frame_stack: int, game_kwargs: dict[str, Any]
    ) -> Any:
        vector_kwargs: dict[str, Any] = {
            **(self._raw_frames() if preprocessing is None else _in_vector_terms(preprocessing)),
            "stack_num": frame_stack,
            "reward_clipping": False,
            "use_fire_reset": False,
            **game_kwargs,
        }
        if self.config.max_episode_steps is not None:
            frames_per_step = int(vector_kwargs.get("frameskip", 4))
            vector_kwargs["max_num_frames_per_episode"] = (
                self.config.max_episode_steps * frames_per_step
            )
        games = gym.make_vec(
            self.config.task_name,
            num_envs=self.num_envs,
            vectorization_mode="vector_entry_point",
            **vector_kwargs,
        )
        self.autoreset = games.metadata["autoreset_mode"].name.lower()
        return games if frame_stack > 1 else _without_stack_axis(games)

    def _raw_frames(self) -> dict[str, Any]:
        game = gym.make(self.config.task_name)
        height, width, _ = cast("tuple[int, int, int]", game.observation_space.shape)
        game.close()
        return {
            "img_height": height,
            "img_width": width,
            "grayscale": False,
            "maxpool": False,
            "noop_max": 0,
        }

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        if self.num_envs == 1:
            return super().reset(seed=seed, options=options)
        seeds: Any = None
        if seed is not None:
            seeds = np.asarray(sub_env_seeds(self, seed))
        elif not self._is_seeded:
            # ale-py would seed with the time in seconds, the same for all workers.
            seeds = np.random.default_rng().integers(2**31 - 1, size=self.num_envs)
        self._is_seeded = True
        return super().reset(seed=seeds, options=options)


def _in_vector_terms(preprocessing: dict[str, Any]) -> dict[str, Any]:
    """Convert options of `AtariPreprocessing` to those of ale-py's vector environment."""
    width, height = preprocessing["screen_size"]
    return {
        "img_height": height,
        "img_width": width,
        "grayscale": preprocessing["grayscale_obs"],
        "frameskip": preprocessing["frame_skip"],
        "maxpool": preprocessing["frame_skip"] > 1,
        "noop_max": preprocessing["noop_max"],
        "episodic_life": preprocessing["terminal_on_life_loss"],
    }


def _without_stack_axis(games: Any) -> Any:
    """Remove the axis of a stack of one frame from observations."""
    stacked = games.single_observation_space
    frame = Box(0, 255, stacked.shape[1:], np.uint8)
    return TransformObservation(games, lambda frames: frames[:, 0], single_observation_space=frame)
