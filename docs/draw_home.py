"""Make the film of the home page: 16 envs of four simulators, first come, first served.

    python docs/draw_home.py

One group holds all of them. Each tile shows what its env rendered last; it is outlined when
`collect_async` returns its result. Policies are random. Where a machine has no EGL, set MUJOCO_GL.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw

from rlightning_aio import EnvConfig
from rlightning_aio.sync import build_env_group

os.environ.setdefault("MUJOCO_GL", "egl")
FILM = Path(__file__).resolve().parent / "pictures" / "first_ready.webp"
# Task, arguments of `gymnasium.make`, and seconds that a step takes beside its simulation.
TASKS: tuple[tuple[str, dict[str, Any], float], ...] = (
    ("HalfCheetah-v5", {"width": 240, "height": 180}, 0.08),
    ("CartPole-v1", {}, 0.04),
    ("Acrobot-v1", {}, 0.12),
    ("Pendulum-v1", {}, 0.06),
)
ENVS_OF_TASK, FRAMES, BEFORE = 4, 36, 30
WIDTH, HEIGHT, GAP = 132, 99, 6
READY, IDLE = (255, 167, 38), (222, 224, 232)


class Uneven(gym.Wrapper[Any, Any, Any, Any]):
    """An env whose steps take unequal times."""

    def __init__(self, env: gym.Env[Any, Any], seconds: float) -> None:
        super().__init__(env)
        self._seconds, self._rng = seconds, np.random.default_rng()

    def step(self, action: Any) -> Any:
        time.sleep(self._rng.exponential(self._seconds))
        return self.env.step(action)


def make(task: str, kwargs: dict[str, Any], seconds: float) -> gym.Env[Any, Any]:
    """Make one env."""
    return Uneven(gym.make(task, render_mode="rgb_array", **kwargs), seconds)


def entries() -> list[EnvConfig]:
    """One entry for each task; an env to a process, so that rendering holds nobody up."""
    return [
        EnvConfig(
            name=task.partition("-")[0],
            task=lambda task=task, kwargs=kwargs, seconds=seconds: make(task, kwargs, seconds),
            num_workers=ENVS_OF_TASK,
            envs_per_process=1,
            max_episode_steps=200,
        )
        for task, kwargs, seconds in TASKS
    ]


def tile(picture: Any) -> Image.Image:
    """A frame, cut to the shape of a tile."""
    image = Image.fromarray(np.asarray(picture))
    width = min(image.width, image.height * WIDTH // HEIGHT)
    height = min(image.height, image.width * HEIGHT // WIDTH)
    left, top = (image.width - width) // 2, (image.height - height) // 2
    return image.crop((left, top, left + width, top + height)).resize((WIDTH, HEIGHT))


def frame(tiles: dict[str, Image.Image], ready: set[str]) -> Image.Image:
    """All tiles, those of `ready` envs outlined."""
    columns, rows = ENVS_OF_TASK, len(TASKS)
    size = columns * (WIDTH + GAP) + GAP, rows * (HEIGHT + GAP) + GAP
    image = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(image)
    for k, (env_id, picture) in enumerate(tiles.items()):
        x = GAP + k % columns * (WIDTH + GAP)
        y = GAP + k // columns * (HEIGHT + GAP)
        box = (x - 4, y - 4, x + WIDTH + 3, y + HEIGHT + 3)
        draw.rectangle(box, READY if env_id in ready else IDLE)
        image.paste(picture, (x, y))
    return image


def main() -> None:
    """Step the envs, and write the film."""
    frames: list[Image.Image] = []
    with build_env_group(entries(), mixed_actions=True) as group, group.auto_reset():
        batch, _ = group.reset(seed=0)
        spaces = dict(zip(group.env_ids, group.get_action_spaces(), strict=True))
        tiles = {env_id: tile(group[env_id].render()) for env_id in group.env_ids}
        for turn in range(BEFORE + FRAMES):
            actions = [spaces[env_id].sample() for env_id in batch.ids()]
            group.step_async(batch.respond(action=actions))
            batch, _ = group.collect_async(min_results=3)
            for env_id in batch.ids():
                tiles[env_id] = tile(group[env_id].render())
            if turn >= BEFORE:
                frames.append(frame(tiles, set(batch.ids())))
        group.collect_async(wait_all=True)
    FILM.parent.mkdir(exist_ok=True)
    frames[0].save(
        FILM, save_all=True, append_images=frames[1:], duration=120, loop=0, quality=45, method=6
    )


if __name__ == "__main__":
    main()
