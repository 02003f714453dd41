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
        (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert str(folder) in line
        assert "playing" not in done.stderr


def test_after_an_error_only_episodes_of_the_queue_are_reported(tmp_path: Path) -> None:
    """The results file has others besides."""
    config, file = write_config(tmp_path, POLE), tmp_path / "results.jsonl"
    policy = "cli.stub_policies:breaks_soon"
    words = ("eval", config, "--policy", policy, "--resume", file)
    assert invoke_json(*words, "--seeds", "0:6")["episodes"] == 6
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cli.stub_policies.calls_left", 0)
        done = invoke(*words, "--seeds", "4:8")
    assert done.exit_code == 1
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("CartPole-v1 ")]
    assert line.split()[1] == "2"
