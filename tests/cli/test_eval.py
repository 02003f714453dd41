"""``rlightning-aio eval`` plays equal numbers of episodes and prints statistics."""

from __future__ import annotations

import json
import os
import signal
from typing import TYPE_CHECKING, Any

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, line_with, run, start, write_config
from patience import HANG

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

POLE = {**CARTPOLE, "placement": "inline", "num_workers": 3}
STUB = {"name": "stub", "backend": "stub", "task": "any", "placement": "inline"}


def by_number(episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(episodes, key=lambda one: (one["env_id"], one["sub_env"], one["index"]))


def results_of(attempts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What came of each, by env and number, whenever it was played."""
    names = ("env_id", "index", "seed", "reward", "length", "success")
    return [{name: one[name] for name in names} for one in by_number(attempts)]


def test_each_env_plays_the_same_number_of_episodes(tmp_path: Path) -> None:
    """The command prints a line with intervals for each entry; JSON has all episodes."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 3})
    done = run("eval", config, "--episodes", 2, "--seed", 0)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("random: 2 episodes of each env")
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("pole")]
    assert line.split()[1] == "6"
    document = invoke_json("eval", config, "--episodes", 2, "--seed", 0)
    assert not document["interrupted"]
    (entry,) = document["parts"]
    assert (document["by"], entry["name"]) == ("entry", "pole")
    reward = entry["total_reward"]
    assert reward["low"] < reward["mean"] < reward["high"]
    played = [(one["env_id"], one["index"]) for one in by_number(document["attempts"])]
    assert played == [(f"pole-{k}", n) for k in range(3) for n in range(2)]


def test_the_name_of_an_entry_may_have_a_slash(tmp_path: Path) -> None:
    config = write_config(tmp_path, {**POLE, "name": "my/cart"})
    played = invoke_json("eval", config, "--episodes", 1)["attempts"]
    assert {one["env_id"] for one in played} == {f"my/cart-{k}" for k in range(3)}
    assert invoke_json("rollout", config, "--steps", 9)


def test_resume_does_not_repeat_finished_episodes(tmp_path: Path) -> None:
    """An evaluation in two parts has the results of one in a single part."""
    config, file = write_config(tmp_path, POLE), tmp_path / "episodes.jsonl"
    asked = ("eval", config, "--seed", 3, "--policy", "cli.stub_policies:respond")
    whole = invoke_json(*asked, "--episodes", 4)
    invoke_json(*asked, "--episodes", 2, "--resume", file)
    # The command ended in the middle of a line.
    file.write_text(file.read_text() + '{"task": "pole-0", "sub')
    lines = len(file.read_text().splitlines()) - 1
    both = invoke_json(*asked, "--episodes", 4, "--resume", file)
    assert results_of(both["attempts"]) == results_of(whole["attempts"])
    assert (lines, len(file.read_text().splitlines())) == (1 + 6, 1 + 12)
    fewer = invoke_json(*asked, "--episodes", 1, "--resume", file)
    assert len(fewer["attempts"]) == 3


def test_ctrl_c_keeps_finished_episodes(tmp_path: Path) -> None:
    """The summary says that it is no fair sample, and a film of them is there."""
    config = write_config(
        tmp_path, {"name": "slow", "task": "cli.judged_env:Waiting", "num_workers": 2}
    )
    file, films = tmp_path / "episodes.jsonl", tmp_path / "films"
    asked = ("--episodes", 2, "--resume", file, "--video", films, "--seed", 0, "--json")
    with start("eval", config, *asked) as child:
        line_with(child, "waits")
        child.send_signal(signal.SIGINT)
        stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130, stderr
    document = json.loads(stdout)
    assert document["interrupted"]
    assert [one["env_id"] for one in document["attempts"]] == ["slow-0"]
    assert len(file.read_text().splitlines()) == 2
    (film,) = films.iterdir()
    assert film.name.endswith("-seed-0-slow-0-episode-0.mp4")


def test_an_error_of_the_policy_is_no_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was played before is shown, how much that is, and why there is no more."""
    config = write_config(tmp_path, {**POLE, "num_workers": 1, "max_episode_steps": 2})
    words = ("eval", config, "--episodes", 20, "--policy", "cli.stub_policies:breaks_soon")
    monkeypatch.setattr("cli.stub_policies.calls_left", 13)
    done = invoke(*words, "--json")
    document = json.loads(done.stdout)
    assert (done.exit_code, document["interrupted"], document["episodes"]) == (1, False, 6)
    monkeypatch.setattr("cli.stub_policies.calls_left", 13)
    table = " ".join(invoke(*words).stdout.split())
    assert table.startswith("Ended by an error after 6 episodes, so short ones are favoured: ")
    assert "20 episodes of each env were to be played" in table


def test_a_full_disk_leaves_complete_lines(small_disk: Path) -> None:
    """Results so far are printed, and the rest is played later."""
    config, file = write_config(small_disk, POLE), small_disk / "episodes.jsonl"
    invoke_json("eval", config, "--episodes", 1, "--resume", file)
    free = os.statvfs(small_disk)
    (small_disk / "rest").write_bytes(bytes(free.f_bavail * free.f_bsize - 4096))
    done = invoke("eval", config, "--episodes", 60, "--resume", file, "--json")
    assert done.exit_code == 2
    assert done.stderr.endswith("episodes.jsonl: can't be written: No space left on device\n")
    whole = file.read_text()
    assert whole.endswith("}\n")
    kept = len(whole.splitlines()) - 1
    assert 3 < kept < 180
    assert len(json.loads(done.stdout)["attempts"]) == kept
    (small_disk / "rest").unlink()
    assert len(invoke_json("eval", config, "--episodes", 60, "--resume", file)["attempts"]) == 180


def refused(*words: object) -> str:
    done = invoke("eval", *words)
    assert done.exit_code == 2
    assert done.stdout == ""
    return str(done.stderr)


def test_a_file_of_another_evaluation_is_left_unchanged(tmp_path: Path) -> None:
    """So is a file with other contents."""
    config, file = write_config(tmp_path, POLE), tmp_path / "episodes.jsonl"
    invoke_json("eval", config, "--episodes", 1, "--seed", 3, "--resume", file)
    before = file.read_bytes()
    assert "'seed': 3" in refused(config, "--seed", 4, "--resume", file)
    policy = ("--policy", "cli.stub_policies:respond", "--seed", 3)
    assert "belongs to {" in refused(config, *policy, "--resume", file)
    assert file.read_bytes() == before
    for text in ("notes", "notes\nmore notes\n", "[1]\n"):
        file.write_text(text)
        assert "is not a file of results" in refused(config, "--resume", file)
        assert file.read_text() == text


# -- a queue of episodes ----------------------------------------------------------------

SWITCHING = {"name": "many", "task": "cli.judged_env:Switching", "placement": "inline"}


def test_a_queue_plays_each_task_with_each_seed(tmp_path: Path) -> None:
    """Figures are by task, whichever envs play; the file resumes with another number of them."""
    config, file = write_config(tmp_path, {**SWITCHING, "num_workers": 3}), tmp_path / "rows.jsonl"
    invoke_json("eval", config, "--tasks", "a,b", "--seeds", "0:3", "--resume", file)
    asked = ("--tasks", "a,b", "--tasks", "c", "--seeds", "0:4", "--resume", file)
    done = run("eval", config, "envs.0.num_workers=2", *asked)
    assert done.returncode == 0, done.stderr
    assert "playing 12 episodes, 6 of them played before" in done.stderr
    table = {line.split()[0]: line.split()[1:3] for line in done.stdout.splitlines()[2:]}
    assert table == {**{task: ["4", "0.50"] for task in "abc"}, "all": ["12", "0.50"]}
    document = invoke_json("eval", config, *asked)
    assert [(one["name"], one["episodes"]) for one in document["parts"]] == [
        (task, 4) for task in "abc"
    ]
    assert sorted((one["task"], one["seed"]) for one in document["attempts"]) == [
        (task, seed) for task in "abc" for seed in range(4)
    ]
    assert (document["by"], document["episodes"], document["failed"]) == ("task", 12, 0)
    assert "the queue has" in refused(config, "--seeds", "1,1")


def test_an_episode_that_fails_is_told_of(tmp_path: Path) -> None:
    """The others are in the table, and the exit code says that some have no result."""
    config = write_config(tmp_path, SWITCHING)
    done = run("eval", config, "--tasks", "a,raises", "--seeds", "0:2", "--retries", 1)
    assert done.returncode == 1
    assert "by the kind of their outcome: 4 not_started" in done.stdout
    assert "failed: task 'raises', seed 1, on env 'many-0': not_started: " in done.stdout
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("a ")]
    assert line.split()[1:3] == ["2", "0.50"]


def test_a_film_that_cannot_be_kept_ends_it_with_one_message(tmp_path: Path) -> None:
    """The episodes until then are printed."""
    config = write_config(tmp_path, SWITCHING)
    films = tmp_path / "films"
    (films / "many-b-seed-1.mp4").mkdir(parents=True)
    asked = ("--tasks", "a,b", "--seeds", 1, "--video", films, "--json")
    done = run("eval", config, *asked)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert "it is no regular file" in line
    assert str(films) in line
    assert "Traceback" not in done.stderr
    assert [one["task"] for one in json.loads(done.stdout)["attempts"]] == ["a"]


def test_after_an_error_only_episodes_of_the_queue_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The results file has others besides."""
    config, file = (
        write_config(tmp_path, {**POLE, "max_episode_steps": 4}),
        tmp_path / "results.jsonl",
    )
    policy = "cli.stub_policies:breaks_soon"
    words = ("eval", config, "--policy", policy, "--resume", file)
    assert invoke_json(*words, "--seeds", "0:6")["episodes"] == 6
    monkeypatch.setattr("cli.stub_policies.calls_left", 0)
    done = invoke(*words, "--seeds", "4:8")
    assert done.exit_code == 1
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("CartPole-v1 ")]
    assert line.split()[1] == "2"


@pytest.mark.parametrize("folder", [__file__, "/proc/films"])
def test_a_folder_that_can_not_be_written_is_named(tmp_path: Path, folder: str) -> None:
    """Before anything is played."""
    said = refused(write_config(tmp_path, POLE), "--seeds", "0:2", "--video", folder)
    assert [folder in line for line in said.splitlines() if line.startswith("error: ")] == [True]
    assert "playing" not in said
