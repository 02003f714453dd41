"""``rlightning-aio eval``: equally many episodes of each env, and what they say of a policy."""

from __future__ import annotations

import json
import signal
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest
from cli.command import CARTPOLE, invoke, invoke_json, run, start, write_config
from patience import HANG
from timelines import Seen

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

POLE = {**CARTPOLE, "placement": "inline", "num_workers": 3}
STUB = {"name": "stub", "backend": "stub", "task": "any", "placement": "inline"}
JUDGED = {"name": "judged", "task": "cli.judged_env:make", "placement": "inline"}


def by_number(episodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(episodes, key=lambda one: (one["env_id"], one["number"]))


def test_each_env_plays_equally_many_episodes(tmp_path: Path) -> None:
    """The real command prints a line for each entry, with intervals; by JSON all episodes."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 3})
    done = run("eval", config, "--episodes", 2, "--seed", 0)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("random: 2 episodes of each env")
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("pole")]
    assert line.split()[1:3] == ["3", "6"]
    document = invoke_json("eval", config, "--episodes", 2, "--seed", 0)
    assert not document["interrupted"]
    (entry,) = document["entries"]
    reward = entry["total_reward"]
    assert reward["low"] < reward["mean"] < reward["high"]
    played = [(one["env_id"], one["number"]) for one in by_number(document["episodes"])]
    assert played == [(f"pole-{k}", n) for k in range(3) for n in range(2)]


def test_success_is_judged(tmp_path: Path) -> None:
    """By what the last info says; of an env that says nothing there is no rate."""
    config = write_config(tmp_path, {**JUDGED, "num_workers": 2}, STUB)
    judged, stub = invoke_json("eval", config, "--episodes", 5, "--seed", 0)["entries"]
    assert judged["success"]["mean"] == 0.5
    assert judged["success"]["low"] == pytest.approx(0.2366, abs=5e-5)
    assert stub["success"] is None
    assert (stub["episodes"], stub["length"]["mean"]) == (5, 10)


def test_a_policy_is_named(tmp_path: Path) -> None:
    """By its module, as for rollout; a step limit holds."""
    config = write_config(tmp_path, {**POLE, "max_episode_steps": 4})
    policy = "cli.stub_policies:respond"
    document = invoke_json("eval", config, "--episodes", 2, "--policy", policy)
    assert document["policy"] == policy
    assert document["entries"][0]["length"]["mean"] == 4


def test_finished_episodes_are_not_played_again(tmp_path: Path) -> None:
    """What an evaluation in two parts says is what one in a single part says."""
    config, file = write_config(tmp_path, POLE), tmp_path / "episodes.jsonl"
    asked = ("eval", config, "--seed", 3, "--policy", "cli.stub_policies:respond")
    whole = invoke_json(*asked, "--episodes", 4)
    invoke_json(*asked, "--episodes", 2, "--resume", file)
    # Ended in the middle of a line.
    file.write_text(file.read_text() + '{"env_id": "pole-0", "sub')
    lines = len(file.read_text().splitlines()) - 1
    both = invoke_json(*asked, "--episodes", 4, "--resume", file)
    assert by_number(both["episodes"]) == by_number(whole["episodes"])
    assert (lines, len(file.read_text().splitlines())) == (1 + 6, 1 + 12)
    fewer = invoke_json(*asked, "--episodes", 1, "--resume", file)
    assert len(fewer["episodes"]) == 3


def test_ctrl_c_keeps_what_was_played(tmp_path: Path) -> None:
    """The summary says that it is no fair sample, and its film has a mark of its own."""
    config = write_config(
        tmp_path, {"name": "slow", "task": "cli.judged_env:wait", "num_workers": 2}
    )
    file, films = tmp_path / "episodes.jsonl", tmp_path / "films"
    asked = ("--episodes", 2, "--resume", file, "--video", films, "--seed", 0, "--json")
    with start("eval", config, *asked) as child:
        assert child.stderr is not None
        while "waits" not in (line := child.stderr.readline()):
            assert line, "it has ended"
        child.send_signal(signal.SIGINT)
        stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 130, stderr
    document = json.loads(stdout)
    assert document["interrupted"]
    assert [one["env_id"] for one in document["episodes"]] == ["slow-0"]
    assert len(file.read_text().splitlines()) == 2
    names = {path.name for path in films.iterdir()}
    assert names == {"slow-0-episode-0.mp4", "slow-0-episode-1.partial.mp4"}


def test_it_is_drawn_filmed_and_traced(tmp_path: Path) -> None:
    """In the files that were named; the timeline holds each episode from its reset on."""
    config = write_config(tmp_path, {**JUDGED, "num_workers": 2}, STUB)
    plot, films, trace = tmp_path / "plot.png", tmp_path / "films", tmp_path / "run.json"
    filming = ("--video", films, "--video-env", "judged-1", "--video-every", 2)
    drawing = ("--plot", plot, "--trace", trace, "--json")
    # In a process of its own: matplotlib keeps its fonts open.
    done = run("eval", config, "--episodes", 3, "--seed", 0, *drawing, *filming)
    assert done.returncode == 0, done.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
    names = sorted(path.name for path in films.iterdir())
    assert names == ["judged-1-episode-0.mp4", "judged-1-episode-2.mp4"]
    seen = Seen(trace)
    played = Counter(one["env_id"] for one in json.loads(done.stdout)["episodes"])
    for env_id, count in played.items():
        lasted = [one.name for one in seen.of(env_id)]
        assert lasted[0] == "reset"
        assert lasted.count("reset") >= count == 3
    assert seen.called("policy")
    absent = tmp_path / "absent" / "run.json"
    assert "there is no folder" in refused(config, "--trace", absent)


def refused(*words: object) -> str:
    done = invoke("eval", *words)
    assert done.exit_code == 2
    assert done.stdout == ""
    return str(done.stderr)


def test_what_is_wrong_is_told_before_anything_starts(tmp_path: Path) -> None:
    """By the option, with what to do."""
    config = write_config(tmp_path, POLE)
    assert "there is no such file" in refused(config, "--policy", "absent.zip")
    assert "--algo is for a model" in refused(config, "--algo", "PPO")
    assert "add --video FOLDER" in refused(config, "--video-every", 2)
    assert "did you mean 'pole-0'" in refused(
        config, "--video", tmp_path / "films", "--video-env", "pole_0"
    )
    assert "can't be written" in refused(config, "--resume", tmp_path / "absent" / "file")
    (tmp_path / "zip.zip").write_text("nothing")
    assert "name it with --algo" in refused(config, "--policy", tmp_path / "zip.zip")
    server = write_config(tmp_path, {"name": "robots", "backend": "env_server"})
    assert "'robots'), backend: clients of an env_server come and go" in refused(server)


def test_a_file_of_another_evaluation_is_left_as_it_is(tmp_path: Path) -> None:
    """Nor is one overwritten that holds something else."""
    config, file = write_config(tmp_path, POLE), tmp_path / "episodes.jsonl"
    invoke_json("eval", config, "--episodes", 1, "--seed", 3, "--resume", file)
    before = file.read_bytes()
    assert "its seed is 3, not 4" in refused(config, "--seed", 4, "--resume", file)
    assert file.read_bytes() == before
    for text in ("notes", "notes\nmore notes\n", "[1]\n", "{}\n"):
        file.write_text(text)
        assert "is not a file that eval has written" in refused(config, "--resume", file)
        assert file.read_text() == text


@pytest.mark.simulators
@pytest.mark.parametrize(("algorithm", "together"), [("PPO", False), ("A2C", False), ("DQN", True)])
def test_a_model_of_stable_baselines3(tmp_path: Path, algorithm: str, together: bool) -> None:
    """The algorithm is read from the file; each episode is what the model plays by itself."""
    sb3 = pytest.importorskip("stable_baselines3")
    import gymnasium as gym

    model = getattr(sb3, algorithm)("MlpPolicy", "CartPole-v1", seed=1, device="cpu")
    model.save(tmp_path / "model.zip")
    lengths = []
    for seed in range(3):
        env = gym.make("CartPole-v1")
        observation, _ = env.reset(seed=seed)
        done, steps = False, 0
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, _ = env.step(action)
            done, steps = terminated or truncated, steps + 1
        lengths.append(steps)
    poles = {"name": "poles", "task": "cli.judged_env:poles", "placement": "inline"}
    config = write_config(tmp_path, poles if together else POLE)
    asked = ("--policy", tmp_path / "model.zip", "--episodes", 1, "--seed", 0)
    found = invoke_json("eval", config, *asked)["episodes"]
    found.sort(key=lambda one: (one["env_id"], one["sub_env"]))
    assert [one["length"] for one in found] == lengths
    pendulum = {**POLE, "name": "pendulum", "task": "Pendulum-v1"}
    other = write_config(tmp_path, pendulum)
    assert "those of env 'pendulum-0' are Box" in refused(other, *asked)
    assert "no such algorithm" in refused(config, *asked, "--algo", "PQN")
    assert "can't be loaded as SAC" in refused(config, *asked, "--algo", "SAC")
