"""`evaluate` with a queue: wrong episodes, policies that leave envs out, and rare losses."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_evaluation_queue import Tasks, evaluated, group_of, rows

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, ResultsFile, evaluate


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"seed": -1}, "the seed must be an int from 0"),
        ({"seed": 1 << 62}, "the seed must be an int from 0"),
        ({"seed": "3"}, "the seed must be an int from 0"),
        ({"seed": 1.5}, "the seed must be an int from 0"),
        ({"task": 3}, "the task of an episode should be a str, not 3"),
        ({"entry": None}, "the entry of an episode should be a str, not None"),
        ({"options": [1]}, r"the options of an episode should be a dict, not \[1\]"),
        ({"options": {"x": float("nan")}}, "the options of an episode can't be written as JSON"),
        ({"options": {"x": object()}}, "object .* is neither a number, a text, a list nor an arr"),
    ],
)
def test_an_episode_that_can_not_be_is_refused(fields: dict[str, Any], message: str) -> None:
    """When it is made, so that the line of a file can be named."""
    with pytest.raises(ValueError, match=message):
        EpisodeSpec(**{"task": "1", "seed": 0, **fields})


def test_numbers_of_numpy_are_saved_and_found_again(tmp_path: Path) -> None:
    """As seeds and in options, where they are values and not texts."""
    queue = [EpisodeSpec("1", seed, {"longer": np.int64(2)}) for seed in np.arange(3)]
    for _ in range(2):
        with ResultsFile(tmp_path / "results.jsonl") as results:
            found = evaluated(group_of(), queue, results=results)
        assert sorted((one.spec.seed, one.length) for one in found.attempts) == [
            (0, 3),
            (1, 4),
            (2, 5),
        ]
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    assert [json.loads(line)["options"] for line in lines[1:]] == [{"longer": 2}] * 3


ONE = EpisodeSpec("1", 0)


@pytest.mark.parametrize(
    ("episodes", "options", "message"),
    [
        (0, {}, "episodes must be at least 1, not 0"),
        (1, {"retries": -1}, "retries must be at least 0, not -1"),
        ([ONE], {"seed": 3}, "seed is for a number of episodes"),
        ([("1", 0)], {}, r"should be EpisodeSpec, not \('1', 0\)"),
        ([EpisodeSpec("1", 0, {"task": "3"})], {}, r"options .*name a task.*task='1'"),
        ([EpisodeSpec("1", 0, entry="other")], {}, "no entry 'other'; entries are env"),
        ([EpisodeSpec("1", 0, env_id="other-0")], {}, "there is no env 'other-0' to play"),
    ],
)
def test_what_can_not_be_evaluated_is_refused(
    episodes: Any, options: dict[str, Any], message: str
) -> None:
    """Before anything is sent."""
    with pytest.raises((ValueError, TypeError), match=message):
        evaluated(group_of(), episodes, **options)


def test_a_queue_for_sub_environments_is_refused() -> None:
    """They would end their episodes together."""
    pole = sync.build_env_group("CartPole-v1", num_envs=2, placement="inline")
    with pytest.raises(ValueError, match="has 2 sub-environments"):
        evaluated(pole, [])


def test_clients_that_have_not_dialled_in_are_not_evaluated() -> None:
    """Their spaces are not known."""
    server = {"name": "robots", "backend": "env_server"}
    refused = pytest.raises(ValueError, match="no client has dialled in for robots-0/0")
    with sync.build_env_group(server) as group, refused:
        evaluate(group, None, 1)


@pytest.mark.parametrize("as_list", [True, False])
def test_a_policy_must_answer_all_results(as_list: bool) -> None:
    """The episodes of the others would never end."""

    def policy(batch: rl.BatchedData) -> Any:
        answer = batch.take([0]).respond(action=[0])
        return [answer] if as_list else answer

    with pytest.raises(rl.BadAction, match="has answered 1 of 3 results"):
        evaluated(group_of(), policy=policy, min_results=3)


class Dies(Tasks):
    """The third step of seed 9 ends the process, once.

    It takes long enough for the trainer to ask another env of the process for a film, usually.
    """

    def __init__(self, folder: str) -> None:
        super().__init__()
        self._folder = folder

    def step(self, action: Any) -> Any:
        flag = Path(self._folder, "died")
        if self.seed == 9 and self.steps == 2 and not flag.exists():
            flag.touch()
            time.sleep(0.3)
            os._exit(3)
        return super().step(action)


def test_a_process_that_ends_while_a_film_begins_is_replaced(tmp_path: Path) -> None:
    """The film is of another env of the process than the one that ended it."""
    queue = [EpisodeSpec("1", seed) for seed in (2, 9, 1, 0, 3)]
    fields = {"task": Dies, "env_kwargs": {"folder": str(tmp_path)}, "envs_per_process": 2}
    found = evaluated(group_of(2, placement="process", **fields), queue, video=tmp_path / "films")
    assert rows(found) == [("1", seed, seed + 1.0, seed + 1) for seed in (0, 1, 2, 3, 9)]
    assert not found.failed
