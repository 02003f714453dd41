"""Films of episodes: their choice, their frames, and films of unfinished episodes."""

from __future__ import annotations

import subprocess
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from kit.scripted import DIE, RAISE, Awaitable, Scripted

import rlightning_aio as rl
from rlightning_aio import sync

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from pathlib import Path

STEP = 8
"""The difference in brightness between successive frames."""


class Brighter(Scripted):
    """Its frames get brighter with each step; an episode has three."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # Gymnasium's.
    length = 3
    size = (32, 48)

    def __init__(self, render_mode: str | None = "rgb_array", start: int = 0) -> None:
        self.render_mode, self._start, self.rendered = render_mode, start, 0

    def render(self) -> Any:
        self.rendered += 1
        return np.full((*self.size, 3), self._start + STEP * self.steps, np.uint8)


class Odd(Brighter):
    """Frames of a size that most players don't support."""

    size = (31, 47)


class Endless(Brighter):
    """Its episodes never end by themselves."""

    length = 10**9


def ffmpeg(path: Path, *to: str) -> subprocess.CompletedProcess[bytes]:
    program = imageio_ffmpeg.get_ffmpeg_exe()
    return subprocess.run([program, "-i", str(path), *to], capture_output=True, check=False)


def brightness(path: Path) -> list[int]:
    """Return the brightness of each frame, in steps."""
    done = ffmpeg(path, "-vf", "scale=1:1:flags=area", "-pix_fmt", "gray", "-f", "rawvideo", "-")
    assert done.returncode == 0, done.stderr
    return [round(byte / STEP) for byte in done.stdout]


def films(folder: Path) -> dict[str, list[int]]:
    return {path.name: brightness(path) for path in sorted(folder.iterdir())}


def entry(make_env: Callable[[], Any], **fields: Any) -> dict[str, Any]:
    return {"name": "env", "task": make_env, "placement": "inline", **fields}


@contextmanager
def filming(config: dict[str, Any], folder: Path, **chosen: Any) -> Generator[sync.EnvGroup]:
    """Yield a group whose envs are filmed from their first episode on."""
    with sync.build_env_group(config) as group:
        group.record_video(folder, **chosen)
        yield group


def test_films_of_an_entry_whose_name_is_a_path_stay_in_their_folder(tmp_path: Path) -> None:
    """A second run continues their numbers."""
    config = {**entry(Brighter), "name": "../mine"}
    for _ in range(2):
        with filming(config, tmp_path / "films") as group:
            play(group, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["films"]
    names = sorted(path.name for path in (tmp_path / "films").iterdir())
    assert [name.partition("-episode-")[2] for name in names] == ["0.mp4", "1.mp4"]


def play(group: sync.EnvGroup, num_steps: int, action: Any = 0) -> None:
    """Reset and step all envs; reset those whose episode has ended."""
    batch, _ = group.reset()
    with group.auto_reset(100):
        for _ in range(num_steps):
            batch, _ = group.step(batch.respond(action=[action] * len(batch)))


def test_each_episode_is_a_film_of_all_its_frames(tmp_path: Path) -> None:
    """From the frame of the reset to that of the last step, also in worker processes."""
    config = entry(Brighter, num_workers=3, placement="process")
    with filming(config, tmp_path, env_ids=["env-0", "env-2"]) as group:
        play(group, 7)
    whole = [0, 1, 2, 3]
    assert films(tmp_path) == {f"env-{k}-episode-{n}.mp4": whole for k in (0, 2) for n in range(2)}


def test_the_film_of_an_unfinished_episode_is_marked(tmp_path: Path) -> None:
    """It can be played after the group has closed."""
    with filming(entry(Brighter), tmp_path) as group:
        play(group, 5)
    assert films(tmp_path) == {
        "env-0-episode-0.mp4": [0, 1, 2, 3],
        "env-0-episode-1.partial.mp4": [0, 1],
    }


def test_a_film_ends_where_a_state_is_restored(tmp_path: Path) -> None:
    """What follows is another past of the same episode; the next episode is filmed."""
    with filming(entry(Brighter), tmp_path) as group:
        batch, _ = group.reset()
        snapshot = group.snapshot()
        batch, _ = group.step(batch.respond(action=[0]))
        batch, _ = group.restore(snapshot)
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=[0]))
        play(group, 3)
    assert films(tmp_path) == {
        "env-0-episode-0.partial.mp4": [0, 1],
        "env-0-episode-1.mp4": [0, 1, 2, 3],
    }


def test_a_step_limit_ends_a_film(tmp_path: Path) -> None:
    """Also that of the group, by the reset that follows."""
    with filming(entry(Endless), tmp_path) as group:
        batch, _ = group.reset()
        with group.auto_reset(2):
            for _ in range(3):
                batch, _ = group.step(batch.respond(action=[0]))
    assert films(tmp_path)["env-0-episode-0.mp4"] == [0, 1, 2]


@pytest.mark.parametrize(
    ("chosen", "numbers"), [({"every": 2}, [0, 2]), ({"episodes": [1, 3]}, [1, 3])]
)
def test_episodes_are_chosen(tmp_path: Path, chosen: dict[str, Any], numbers: list[int]) -> None:
    """Every n-th, or those listed."""
    with filming(entry(Brighter), tmp_path, **chosen) as group:
        play(group, 4 * 4 - 1)
    assert list(films(tmp_path)) == [f"env-0-episode-{n}.mp4" for n in numbers]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_one_of_several_sub_environments_is_filmed(tmp_path: Path, mode: AutoresetMode) -> None:
    """Only its episodes, in each autoreset mode."""

    def make() -> Any:
        return SyncVectorEnv([lambda: Brighter(start=100), Brighter], autoreset_mode=mode)

    with filming(entry(make), tmp_path, sub_env=1) as group:
        batch, _ = group.reset()
        for _ in range(8):
            batch, _ = group.step(batch.respond(action=np.zeros((1, 2), np.int64)))
    seen = films(tmp_path)
    last = [0, 1, 2] if mode == AutoresetMode.SAME_STEP else [0, 1, 2, 3]
    assert seen["env-0-sub-1-episode-0.mp4"] == seen["env-0-sub-1-episode-1.mp4"] == last


def test_frames_of_any_size_and_user_defined_envs(tmp_path: Path) -> None:
    """An odd width or height gets a border."""
    with filming(entry(Odd), tmp_path) as group:
        play(group, 3)
    (path,) = tmp_path.iterdir()
    said = ffmpeg(path).stderr.decode()
    assert " 48x32" in said
    assert " 10 fps" in said


def test_films_are_added_to_a_folder_of_films(tmp_path: Path) -> None:
    """No film is overwritten by another run."""
    for _ in range(2):
        with filming(entry(Brighter), tmp_path) as group:
            play(group, 3)
    assert list(films(tmp_path)) == ["env-0-episode-0.mp4", "env-0-episode-1.mp4"]


async def test_an_awaitable_env_that_is_rebuilt_continues_to_be_filmed(tmp_path: Path) -> None:
    """On the trainer's event loop."""
    config = entry(lambda: Awaitable(Brighter), on_env_error="restart") | {"placement": "loop"}
    async with rl.build_env_group(config) as group:
        await group.record_video(tmp_path)
        batch, _ = await group.reset()
        batch, _ = await group.step(batch.respond(action=[RAISE]))
        assert batch.restarted.all()
        for _ in range(3):
            batch, _ = await group.step(batch.respond(action=[0]))
    assert films(tmp_path) == {"env-0-episode-0.mp4": [0, 1, 2, 3]}


@pytest.mark.parametrize(
    ("config", "action"),
    [
        (entry(Brighter, placement="process"), DIE),
        (entry(Brighter, on_env_error="restart"), RAISE),
    ],
    ids=["a replaced worker", "an env that is rebuilt"],
)
def test_what_takes_the_place_of_an_env_continues_filming(
    tmp_path: Path, config: dict[str, Any], action: int
) -> None:
    """The film of the lost episode is marked, until the next one takes its number."""
    with filming(config, tmp_path) as group:
        play(group, 5)
        batch, _ = group.step(rl.BatchedData(["env-0"], [rl.PolicyResponse("env-0", action)]))
        assert batch.restarted.all()
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=[0]))
    assert films(tmp_path) == {
        "env-0-episode-0.mp4": [0, 1, 2, 3],
        "env-0-episode-1.mp4": [0, 1, 2, 3],
    }


def test_a_replacement_that_cannot_film_plays_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Here a file takes the place of the folder; there is one warning."""
    folder = tmp_path / "films"
    with filming(entry(Brighter, on_env_error="restart"), folder, episodes=[9]) as group:
        batch, _ = group.reset()
        folder.rmdir()
        folder.touch()
        batch, _ = group.step(batch.respond(action=[RAISE]))
        assert batch.restarted.all()
        play(group, 9)
    assert capfd.readouterr().err.count("env 'env-0' is no longer filmed") == 1


@pytest.mark.parametrize("stop", [True, False])
def test_a_replaced_worker_films_what_was_filmed_last(tmp_path: Path, stop: bool) -> None:
    """Nothing, if that had ended; and of an env that shares it nothing, if that never was."""
    with two() as group:
        group.record_video(tmp_path / "first", ["env-0"])
        group.record_video(None if stop else tmp_path / "second", ["env-0"])
        play(group, 1)
        group.step(rl.BatchedData(["env-0"], [rl.PolicyResponse("env-0", DIE)]))
        play(group, 3)
    whole = [0, 1, 2, 3]
    seen = {folder.name: films(folder).get("env-0-episode-1.mp4") for folder in tmp_path.iterdir()}
    assert seen == ({"first": None} if stop else {"first": None, "second": whole})
    assert not list(tmp_path.glob("*/env-1*"))


# -- a running group --------------------------------------------------------------------


def two(**fields: Any) -> sync.EnvGroup:
    """Return a group of two envs, which share a worker."""
    config = entry(Brighter, num_workers=2, placement="process", envs_per_process=2)
    return sync.build_env_group({**config, **fields})


@pytest.fixture(scope="module")
def running() -> Iterator[sync.EnvGroup]:
    with two() as group:
        yield group


def rendered(group: sync.EnvGroup) -> list[int]:
    return [group[env_id].get_attr("rendered") for env_id in group.env_ids]


def test_a_running_group_is_filmed_for_a_while(running: sync.EnvGroup, tmp_path: Path) -> None:
    """Chosen envs and episodes; before and after, and of others, nothing is rendered."""
    play(running, 2)
    before = rendered(running)
    running.record_video(tmp_path, ["env-1"], every=2)
    play(running, 10)
    running.record_video(None, ["env-1"])
    count = rendered(running)
    assert [n - m for n, m in zip(count, before, strict=True)] == [0, 7]
    play(running, 5)
    assert rendered(running) == count
    assert films(tmp_path) == {
        "env-1-episode-0.mp4": [0, 1, 2, 3],
        "env-1-episode-2.partial.mp4": [0, 1, 2],
    }


def test_a_film_begins_with_an_episode(running: sync.EnvGroup, tmp_path: Path) -> None:
    """The current episode isn't filmed. A later call replaces an earlier one."""
    batch, _ = running.reset()
    for folder in ("left", "taken"):
        running.record_video(tmp_path / folder, ["env-0"])
        batch, _ = running.step(batch.respond(action=[0, 0]))
    play(running, 3)
    running.record_video(None, ["env-0"])
    assert films(tmp_path / "left") == {}
    assert films(tmp_path / "taken") == {"env-0-episode-0.mp4": [0, 1, 2, 3]}


def test_all_local_envs_are_filmed_by_default(tmp_path: Path) -> None:
    """Those of clients belong to an env_server, which films none."""
    server = {"name": "robots", "backend": "env_server"}
    with sync.build_env_group([entry(Brighter) | {"num_workers": 2}, server]) as group:
        group.record_video(tmp_path)
        batch, _ = group.reset(env_ids=["env-0", "env-1"])
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=[0, 0]))
    assert films(tmp_path) == {f"env-{k}-episode-0.mp4": [0, 1, 2, 3] for k in range(2)}


def test_a_death_leaves_films_that_can_be_played(tmp_path: Path) -> None:
    """With all earlier frames."""
    with two(on_worker_death="raise") as group:
        group.record_video(tmp_path, group.env_ids)
        play(group, 2)
        with pytest.raises(rl.WorkerDied):
            group.step(rl.BatchedData(["env-0"], [rl.PolicyResponse("env-0", DIE)]))
    names = [f"env-{k}-episode-0.partial.mp4" for k in range(2)]
    for name in names:
        while ffmpeg(tmp_path / name, "-f", "null", "-").returncode:
            """The ffmpeg of the worker that has died is about to end."""
    assert films(tmp_path) == {name: [0, 1, 2] for name in names}


async def test_an_asynchronous_group_is_filmed(tmp_path: Path) -> None:
    """With `await`. Here, one sub-environment of an env is filmed."""
    config = entry(lambda: SyncVectorEnv([Odd, Brighter]), placement="process")
    async with rl.build_env_group(config) as group:
        batch, _ = await group.reset()
        await group.record_video(tmp_path, ["env-0"], sub_env=1, episodes=[1])
        batch, _ = await group.reset()
        for _ in range(8):
            batch, _ = await group.step(batch.respond(action=np.zeros((1, 2), np.int64)))
        await group.record_video(None, ["env-0"])
    assert films(tmp_path) == {"env-0-sub-1-episode-1.mp4": [0, 1, 2, 3]}


def test_if_an_env_cannot_be_filmed_no_env_is_filmed(tmp_path: Path) -> None:
    """The error names the env or the field, and what to do."""
    makers = (Brighter, lambda: Brighter(None))
    with sync.build_env_group({**entry(Brighter, num_workers=2), "task": makers}) as group:
        with pytest.raises(rl.EnvRaised, match="'env-1' can't be filmed: its render_mode is None"):
            group.record_video(tmp_path, group.env_ids)
        with pytest.raises(rl.EnvRaised, match="no sub-environment 2"):
            group.record_video(tmp_path, ["env-0"], sub_env=2)
        with pytest.raises(rl.UnknownEnv, match="'env_0'"):
            group.record_video(tmp_path, ["env_0"])
        wrong: dict[str, Any]
        for wrong in ({"every": 0}, {"sub_env": -1}):
            with pytest.raises(rl.ConfigError, match=r"record_video: (every|sub_env): .* got"):
                group.record_video(tmp_path, ["env-0"], **wrong)
        with pytest.raises(rl.ConfigError, match="folder: should not be empty"):
            group.record_video("", ["env-0"])
        (tmp_path / "file").touch()
        with pytest.raises(rl.EnvRaised, match="File exists"):
            group.record_video(tmp_path / "file", ["env-0"])
        play(group, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# -- errors -----------------------------------------------------------------------------


def test_training_continues_if_a_film_cannot_be_written(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Here its folder is removed; there is one warning."""
    folder = tmp_path / "films"
    with filming(entry(Brighter), folder) as group:
        folder.rmdir()
        play(group, 9)
    assert capfd.readouterr().err.count("env 'env-0' is no longer filmed") == 1


class Blind(gym.vector.VectorEnv[Any, Any, Any]):
    """Renders nothing, like that of ale-py."""

    metadata: ClassVar[Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    num_envs = 2
    single_observation_space = single_action_space = gym.spaces.Discrete(2)
    observation_space = action_space = gym.spaces.MultiDiscrete([2, 2])

    def reset(self, **_: Any) -> Any:
        return np.zeros(2, int), {}


def test_vector_envs_that_render_nothing_raise(tmp_path: Path) -> None:
    """The error says so."""
    with (
        sync.build_env_group({"name": "env", "task": Blind, "placement": "inline"}) as group,
        pytest.raises(rl.EnvRaised, match="'env-0' can't be filmed: a Blind renders nothing"),
    ):
        group.record_video(tmp_path, ["env-0"])
