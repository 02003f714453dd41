"""``rlightning-aio eval`` with a queue: wrong files and folders, and figures after an error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, write_config

if TYPE_CHECKING:
    from pathlib import Path

POLE = {**CARTPOLE, "placement": "inline", "num_workers": 2, "max_episode_steps": 4}


def test_a_folder_that_can_not_be_written_is_named(tmp_path: Path) -> None:
    """Before anything is played."""
    config, file = write_config(tmp_path, POLE), tmp_path / "file"
    file.touch()
    for folder in (file, "/proc/films"):
        done = invoke("eval", config, "--seeds", "0:2", "--video", folder)
        assert done.exit_code == 2
        assert f"--video {folder}: can't be written" in done.stderr
        assert "playing" not in done.stderr


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"task": 3, "seed": 0}', "the task of an episode should be a str"),
        ('{"task": "CartPole-v1", "seed": 0, "options": [1]}', "should be a dict"),
        ('{"task": "CartPole-v1", "seed": 99999999999999999999}', "the seed must be an int"),
        ('{"task": "CartPole-v1", "seed": -1}', "the seed must be an int"),
        ('{"task": "CartPole-v1"}', "seed"),
        ('{"task": "CartPole-v1", "seed": 0, "entry": null}', "the entry of an episode"),
        ('{"task": "CartPole-v1", "seed": 0, "sead": 1}', "sead"),
        ("[1, 2]", "line"),
    ],
)
def test_a_wrong_line_is_named(line: str, message: str, tmp_path: Path) -> None:
    """Before anything starts."""
    file = tmp_path / "episodes.jsonl"
    file.write_text(f'{{"task": "CartPole-v1", "seed": 0}}\n{line}\n')
    done = invoke("eval", write_config(tmp_path, POLE), "--episodes-file", file)
    assert done.exit_code == 2
    assert "line 2: " in done.stderr
    assert message in done.stderr
    assert "starting" not in done.stderr


def test_after_an_error_only_episodes_of_the_queue_are_reported(tmp_path: Path) -> None:
    """The results file has others besides."""
    config, file = write_config(tmp_path, POLE), tmp_path / "results.jsonl"
    policy = "cli.stub_policies:breaks_later"
    words = ("eval", config, "--policy", policy, "--resume", file)
    assert invoke_json(*words, "--seeds", "0:6")["episodes"] == 6
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cli.stub_policies.breaks", True)
        done = invoke(*words, "--seeds", "4:8")
    assert done.exit_code == 1
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("CartPole-v1 ")]
    assert line.split()[1] == "2"


@pytest.mark.parametrize("from_file", [False, True], ids=["seeds", "file"])
def test_episodes_without_a_task_are_filmed(from_file: bool, tmp_path: Path) -> None:
    """They have the task of the config."""
    render = {"env_kwargs": {"render_mode": "rgb_array"}}
    config, file = write_config(tmp_path, {**POLE, **render}), tmp_path / "episodes.jsonl"
    file.write_text('{"seed": 0}\n{"seed": 1}\n')
    queue = ["--episodes-file", file] if from_file else ["--seeds", "0:2"]
    done = invoke("eval", config, *queue, "--video", tmp_path / "films")
    assert done.exit_code == 0, done.stderr
    films = sorted(path.name for path in (tmp_path / "films").iterdir())
    assert films == ["pole-CartPole-v1-seed-0.mp4"]
