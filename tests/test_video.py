"""Films of the episodes of an entry's envs, by Gymnasium's `RecordVideo`."""

from __future__ import annotations

import subprocess
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from kit.scripted import DIE, Awaitable, Scripted

import rlightning_aio as rl
from rlightning_aio import sync

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

STEP = 8
"""The difference in brightness between successive frames."""


class Brighter(Scripted):
    """Its frames get brighter with each step; an episode has three."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # Gymnasium's.
    length = 3

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        self.render_mode = render_mode

    def render(self) -> Any:
        return np.full((32, 48, 3), STEP * self.steps, np.uint8)


def brightness(path: Path) -> list[int]:
    """Return the brightness of each frame, in steps."""
    program = imageio_ffmpeg.get_ffmpeg_exe()
    to = ("-vf", "scale=1:1:flags=area", "-pix_fmt", "gray", "-f", "rawvideo", "-")
    done = subprocess.run([program, "-i", str(path), *to], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    return [round(byte / STEP) for byte in done.stdout]


def films(folder: Path) -> dict[str, list[int]]:
    return {path.name: brightness(path) for path in sorted(folder.iterdir())}


def entry(make_env: Callable[[], Any], record_video: Any, **fields: Any) -> dict[str, Any]:
    kwargs = {"record_video": record_video}
    made = {"name": "env", "task": make_env, "env_kwargs": kwargs, "max_episode_steps": 9}
    return {**made, **fields}


def play(group: sync.EnvGroup, actions: list[int]) -> None:
    with group.auto_reset():
        batch, _ = group.reset()
        for action in actions:
            batch, _ = group.step(batch.respond(action=[action] * len(batch)))


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_episodes_are_filmed_whole(placement: str, tmp_path: Path) -> None:
    """Each has the first observation's frame, and one for each step."""
    config = entry(Brighter, {"folder": str(tmp_path)}, num_workers=2, placement=placement)
    with sync.build_env_group(config) as group:
        play(group, [0] * 7)
    names = [f"env-{k}-episode-{episode}.mp4" for k in range(2) for episode in range(2)]
    assert films(tmp_path) == {name: [0, 1, 2, 3] for name in names}


class Slow(Brighter):
    """A long film takes seconds to write, in which its worker has to live."""

    def close(self) -> None:
        time.sleep(2.0)


def test_an_episode_in_progress_is_filmed_up_to_the_end_of_the_group(tmp_path: Path) -> None:
    with sync.build_env_group(entry(Slow, {"folder": str(tmp_path)})) as group:
        play(group, [0])
    assert films(tmp_path) == {"env-0-episode-0.mp4": [0, 1]}


def test_every_nth_episode_is_filmed_and_nothing_is_written_over(tmp_path: Path) -> None:
    """A replaced worker goes on where the one before it stopped, and so does another group."""
    config = entry(Brighter, {"folder": str(tmp_path), "every": 2})
    with sync.build_env_group(config) as group:
        play(group, [0] * 3 + [0, DIE] + [0] * 7)
    assert films(tmp_path) == {f"env-0-episode-{k}.mp4": [0, 1, 2, 3] for k in (0, 2)}
    with sync.build_env_group(config) as group:
        play(group, [0] * 7)
    assert films(tmp_path) == {f"env-0-episode-{k}.mp4": [0, 1, 2, 3] for k in (0, 2, 4)}


POLE = {"backend": "gymnasium", "task": "CartPole-v1", "num_envs": 2}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"record_video": "films"}, "should be {folder: DIR}"),
        ({"record_video": {"folder": "films", "every": 0}}, "n above 0, not"),
        ({"record_video": {"folder": "films", "evry": 2}}, "should be {folder: DIR}"),
        ({"make_env": lambda: Brighter(None)}, "render_mode is None; set env_kwargs.render_mode"),
        (
            {"make_env": partial(Awaitable, Brighter)},
            "only an entry of single Gymnasium envs",
        ),
        (POLE, "only an entry of single Gymnasium envs"),
    ],
)
def test_what_cannot_be_filmed_is_refused_at_the_start(
    fields: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """The error names the entry and the field, and what to do."""
    config = entry(**{"make_env": Brighter, "record_video": {"folder": str(tmp_path)}} | fields)
    with pytest.raises(rl.ConfigError, match=r"env_kwargs\.record_video: ") as caught:
        sync.build_env_group(config).init()
    assert message in str(caught.value)


def test_an_env_of_a_task_name_is_filmed(tmp_path: Path) -> None:
    films = {"folder": str(tmp_path), "every": 2}
    kwargs = {"render_mode": "rgb_array", "record_video": films}
    with sync.build_env_group("CartPole-v1", env_kwargs=kwargs, max_episode_steps=2) as group:
        play(group, [0] * 3)
        assert isinstance(group.get_action_spaces()[0], gym.spaces.Discrete)
    assert [path.name for path in tmp_path.iterdir()] == ["CartPole-v1-0-episode-0.mp4"]
