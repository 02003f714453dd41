"""Rewards that are NaN, infinite or huge: what can be figured is, and the rest is null."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from cli.command import invoke, invoke_json, run, write_config

from rlightning_aio.evaluation.estimates import mean_estimate

if TYPE_CHECKING:
    from pathlib import Path

REWARDS = {"plain": "1", "unknown": "nan", "endless": "inf", "below": "-inf", "huge": "1e308"}
ODD = ("unknown", "endless", "below", "huge")
"""Three steps of 1e308 are more than a float holds."""


def config(folder: Path, rewards: dict[str, str] = REWARDS) -> str:
    return write_config(
        folder,
        *(
            {
                "name": name,
                "task": "cli.judged_env:Rewarded",
                "env_kwargs": {"reward": reward},
                "placement": "inline",
            }
            for name, reward in rewards.items()
        ),
    )


def strict(constant: str) -> Any:
    raise AssertionError(f"{constant} is not JSON")


def test_an_episode_without_a_reward_has_failed(tmp_path: Path) -> None:
    """NaN, infinity and what can't be added up, as None is in a row."""
    file, plot = tmp_path / "episodes.jsonl", tmp_path / "plot.png"
    words = ("eval", config(tmp_path), "--seed", 0, "--retries", 0, "--resume", file)
    # In a process of its own: matplotlib keeps its fonts open.
    done = run(*words, "--episodes", 2, "--json", "--plot", plot)
    assert (done.returncode, done.stderr.count("warning")) == (1, 0), done.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
    document = json.loads(done.stdout, parse_constant=strict)
    means = {entry["name"]: entry["total_reward"] for entry in document["parts"]}
    assert means.pop("plain")["mean"] == 3.0
    assert means == dict.fromkeys(ODD)
    causes = {one["env_id"]: one["outcome"]["cause"] for one in document["attempts"]}
    assert causes["unknown-0"] == "returned no reward"
    assert causes["huge-0"] == "rewards add up to inf"
    assert document["failures"] == {"env_raised": 8}
    for line in file.read_text().splitlines():
        json.loads(line, parse_constant=strict)


def test_rollout_prints_what_it_collected(tmp_path: Path) -> None:
    words = ("rollout", config(tmp_path), "--seed", 0, "--steps", 200)
    done = run(*words, "--json")
    assert (done.returncode, done.stderr.count("warning")) == (0, 0), done.stderr
    numbers = json.loads(done.stdout, parse_constant=strict)["metrics"]
    returns = [numbers[f"envs/{name}/episode_returns"] for name in REWARDS]
    assert returns == [3.0 * numbers["envs/plain/episodes"], None, None, None, None]
    assert " nan" not in invoke(*words).stdout


def test_ordinary_returns_need_no_note(tmp_path: Path) -> None:
    assert invoke_json("eval", config(tmp_path, {"plain": "1"}))["notes"] == []


def test_a_rollout_says_that_its_means_favour_short_episodes(tmp_path: Path) -> None:
    """And what measures a policy; where no episode has ended, there is no mean."""
    one = config(tmp_path, {"plain": "1"})
    assert "use rlightning-aio eval" in invoke("rollout", one, "--steps", 200).stdout
    assert "rlightning-aio eval" not in invoke("rollout", one, "--steps", 1).stdout


def test_estimates_of_any_finite_values() -> None:
    assert mean_estimate([]) is None
    for values in ([1e308, 1.5e308, 1.7e308], [-1e308, 1.2e308], [5e-324, 0.0], [0.0, 0.0]):
        found = mean_estimate(values)
        assert found is not None
        assert min(values) <= found.mean <= max(values)
        assert found.low is not None
        assert found.high is not None
        assert found.low <= found.mean <= found.high
