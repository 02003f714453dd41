"""``rlightning-aio trace`` says what a timeline shows."""

from __future__ import annotations

import math
import os
import time
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import pytest
from cli.command import CARTPOLE, invoke, invoke_json, write_config
from kit.scripted import Counts
from timelines import Seen

from rlightning_aio import sync

if TYPE_CHECKING:
    from pathlib import Path


class Napping(Counts):
    """Sleeps for as many milliseconds as the action says; dies at 99."""

    action_space = gym.spaces.Discrete(100)

    def does(self, action: Any) -> None:
        if action == 99:
            os._exit(7)
        time.sleep(int(action) / 1000)


def recorded(path: Path, actions: list[list[int]], think: float = 0.0) -> Any:
    """Play steps in lockstep; return the summary of their timeline."""
    with sync.build_env_group(Napping, num_workers=len(actions[0])) as group:
        batch, _ = group.reset(seed=0)
        with group.auto_reset(math.inf), group.trace(path):
            for some in actions:
                with group.span("learner"):
                    time.sleep(think)
                batch, _ = group.step(batch.respond(action=some))
    return invoke_json("trace", path)


def test_its_figures_are_those_of_the_timeline(tmp_path: Path) -> None:
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 4})
    path = tmp_path / "run.json"
    assert invoke("rollout", config, "--steps", "300", "--trace", path).exit_code == 0
    found, seen = invoke_json("trace", path), Seen(path)
    requests = seen.results()
    assert sum(one["steps"] for one in found["envs"]) == len(seen.called("step"))
    assert sum(one["resets"] for one in found["envs"]) == len(
        [one for one in requests if one.name == "reset"]
    )
    for env in found["envs"]:
        busy = sum(one.ended - one.began for one in requests if one.track == env["env_id"])
        assert math.isclose(env["busy"], busy / 1e9, abs_tol=1e-6)
    # A step that had no result when the recording ended may be the slowest of all.
    unfinished = [one for one in seen.slices if one.name.endswith(", not done")]
    longest = max(one.ended - one.began for one in [*requests, *unfinished])
    assert math.isclose(found["slowest"][0]["seconds"], longest / 1e9, abs_tol=1e-6)
    text = invoke("trace", path).stdout
    assert "300 steps of 4 envs" in text
    assert "slowest requests" in text


def test_a_straggler_is_named_and_starves_both_sides(tmp_path: Path) -> None:
    found = recorded(tmp_path / "run.json", [[1, 1, 1, 98]] * 6)
    assert found["verdict"].startswith("Both sides starve")
    assert {one["env_id"] for one in found["slowest"][:6]} == {"Napping-3"}


def test_envs_starve_while_the_learner_works(tmp_path: Path) -> None:
    found = recorded(tmp_path / "run.json", [[1, 1]] * 4, think=0.2)
    assert found["verdict"].startswith("The envs starve")
    assert found["trainer"]["learner"] >= 4 * 0.2


def test_the_trainer_starves_while_envs_work(tmp_path: Path) -> None:
    found = recorded(tmp_path / "run.json", [[98, 98]] * 6)
    assert found["verdict"].startswith("The trainer starves: it waits")
    assert found["trainer_waits"] > 0.5


def test_deaths_and_restarts_have_their_causes(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    found = recorded(path, [[1, 1], [99, 1], [1, 1], [1, 1]])
    (died,) = [event for event in found["events"] if event["what"] == "died"]
    assert "code 7" in died["cause"]
    assert sum(worker["replaced"] for worker in found["workers"]) > 0
    text = invoke("trace", path).stdout
    assert "faults" in text
    assert "code 7" in text


@pytest.mark.parametrize("content", [None, "[]", "{", '{"traceEvents": 1}'])
def test_what_is_no_timeline_is_refused(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "other.json"
    if content is not None:
        path.write_text(content)
    done = invoke("trace", path)
    assert done.exit_code == 2
    assert "other.json" in done.stderr
