"""`evaluate` with a queue: each episode once, on any free env, whatever happens to workers."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import DIE, DIE_LATER, GO, HANG, RAISE, Awaitable, Awaited, Scripted
from test_video import STEP, brightness

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.attempts import file
from rlightning_aio.evaluation import (
    EpisodeSpec,
    Evaluation,
    ResultsFile,
    evaluate,
)

if TYPE_CHECKING:
    from rlightning_aio.attempts import Attempt


class Tasks(Scripted):
    """An episode has as many steps as its seed says, plus one, each with the task as reward.

    It succeeds if the seed is even. ``breaks`` maps tasks to what their first step does.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    render_mode = "rgb_array"

    def __init__(self, switches: bool = True, breaks: dict[str, int] | None = None) -> None:
        self.switches_task = switches
        self._breaks, self._task = breaks or {}, "1"

    def does(self, action: Any) -> float:
        super().does(self._breaks.get(self._task, GO))
        return float(self._task)

    def observed(self) -> Any:
        self._task = self.options.get("task", self._task)
        self.length = (self.seed or 0) + 1 + self.options.get("longer", 0)
        return np.array([float(self._task), self.length - self.steps], np.float64)

    def told(self) -> dict[str, Any]:
        return {"is_success": (self.seed or 0) % 2 == 0} if self.over else {}

    def render(self) -> Any:
        return np.full((16, 16, 3), self.length - self.steps, np.uint8)


def group_of(num_workers: int = 3, **fields: Any) -> sync.EnvGroup:
    entry = {"name": "env", "task": Tasks, "placement": "inline", "num_workers": num_workers}
    return sync.build_env_group({**entry, **fields})


def nothing(batch: rl.BatchedData) -> Any:
    return np.zeros(len(batch), np.int64)


QUEUE = [EpisodeSpec(task, seed) for task in ("1", "2", "3") for seed in range(4)]


def evaluated(group: sync.EnvGroup, episodes: Any = QUEUE, **kwargs: Any) -> Evaluation:
    with group, group.auto_reset(100):
        return evaluate(group, kwargs.pop("policy", nothing), episodes, **kwargs)


def rows(found: Evaluation) -> list[tuple[Any, ...]]:
    return sorted((one.spec.task, one.spec.seed, one.reward, one.length) for one in found.attempts)


ROWS = [(one.task, one.seed, (one.seed + 1.0) * int(one.task), one.seed + 1) for one in QUEUE]


def test_each_episode_runs_once_on_any_free_env() -> None:
    """The policy is called with the ready envs, which all tasks share."""
    sizes: list[int] = []

    def noting(batch: rl.BatchedData) -> Any:
        sizes.append(len(batch))
        return nothing(batch)

    seen: list[Attempt] = []
    found = evaluated(group_of(), policy=noting, on_episode=seen.append, min_results=3)
    assert rows(found) == ROWS
    assert seen == found.attempts
    assert max(sizes) == 3
    assert {one.env_id for one in seen} == {"env-0", "env-1", "env-2"}
    assert all(one.success == (one.spec.seed in (0, 2)) for one in seen)
    assert {one.spec.entry for one in seen} == {"env"}
    assert list(found.by_task()) == ["1", "2", "3"]
    success = found.by_task()["2"].success
    assert success is not None
    assert (success.mean, success.count) == (0.5, 4)


def test_an_env_plays_first_what_only_it_may_play() -> None:
    """Then the queue, first in, first out, whatever task it has."""
    pinned = EpisodeSpec("2", 0, env_id="env-0")
    others = [EpisodeSpec(task, seed) for seed, task in enumerate("112123", start=1)]
    seen: list[Attempt] = []
    evaluated(group_of(1), [*others, pinned], on_episode=seen.append)
    assert [one.spec for one in seen] == [replace(one, entry="env") for one in (pinned, *others)]


def test_an_entry_is_found_by_its_task() -> None:
    """An env that doesn't switch plays its own task; the entry that has the task is preferred."""
    one, two = (
        {
            "name": f"entry-{task}", "backend": "gymnasium", "task": task, "placement": "inline",
        }
        for task in ("CartPole-v1", "MountainCar-v0")
    )  # fmt: skip
    queue = [EpisodeSpec("CartPole-v1", 0), EpisodeSpec("", 1, entry="entry-MountainCar-v0")]
    with sync.build_env_group([one, two]) as group, group.auto_reset(5):
        found = evaluate(group, lambda batch: [0] * len(batch), queue)
        assert {(one.spec.entry, one.spec.task) for one in found.attempts} == {
            ("entry-CartPole-v1", "CartPole-v1"),
            ("entry-MountainCar-v0", "MountainCar-v0"),
        }
        with pytest.raises(ValueError, match=r"no entry of this group can play .*'Pendulum-v1'"):
            evaluate(group, nothing, [EpisodeSpec("Pendulum-v1", 0)])
        with pytest.raises(ValueError, match=r"entries .* can play .*; name one"):
            evaluate(group, nothing, [EpisodeSpec("", 0)])
        with pytest.raises(ValueError, match=r"the queue has .*seed=3.* twice"):
            evaluate(group, nothing, [EpisodeSpec("CartPole-v1", 3)] * 2)


# -- faults -------------------------------------------------------------------------------


def test_an_episode_whose_env_raises_fails_after_some_attempts() -> None:
    """The other episodes are played, and figures are those of played ones."""
    found = evaluated(group_of(env_kwargs={"breaks": {"2": RAISE}}), retries=1)
    assert rows(Evaluation(found.played)) == ROWS[:4] + ROWS[8:]
    assert [one.spec.task for one in found.failed] == ["2"] * 4
    for one in found.failed:
        assert (one.reward, one.length, one.success) == (None, 0, None)
        assert [outcome.kind for outcome in one.failures] == ["env_raised"]
        assert (one.outcome.kind, one.outcome.attempt) == ("env_raised", 1)
        assert one.outcome.cause == "ValueError: as asked"
    assert found.success is not None
    assert (found.success.count, found.failures) == (8, {"env_raised": 8})


@pytest.mark.usefixtures("moving")
@pytest.mark.parametrize("deed", [RAISE, DIE])
def test_what_moves_something_real_is_reset_by_nobody_else_after_a_loss(deed: int) -> None:
    """The others go on; what only it could play has failed, and says what to do."""
    fields = {"env_kwargs": {"breaks": {"2": deed}}, "on_worker_death": "restart"}
    fields |= {"placement": "process", "envs_per_process": 1}
    queue = [EpisodeSpec("2", 0), *(EpisodeSpec("1", seed) for seed in range(8))]
    with group_of(3, **fields) as group, group.auto_reset(100):
        found = evaluate(group, nothing, queue, retries=0)
        (failed,) = found.failed
        assert failed.outcome.kind == ("env_raised" if deed == RAISE else "env_died")
        assert failed.env_id not in {one.env_id for one in found.played}
        group.reset()
        pinned = [EpisodeSpec(task, 0, env_id="env-0") for task in "21"]
        found = evaluate(group, nothing, [*pinned, *queue[1:]], retries=2)
        assert {one.spec.task for one in found.failed} == {"1", "2"}
        assert len(found.played) == 8
        causes = {one.spec.task: one.outcome.cause for one in found.failed}
        assert "group.reset(env_ids=['env-0'])" in causes["1"]
        assert not any(one.failures for one in found.attempts)


@pytest.mark.parametrize("breaks", [DIE, HANG])
def test_only_the_env_at_fault_is_charged_an_attempt(breaks: int) -> None:
    """The others of its worker lose their episodes as well, and play them again."""
    fields = {
        "env_kwargs": {"breaks": {"2": breaks}}, "placement": "process", "envs_per_process": 3,
        "step_timeout": 1.0,
    }  # fmt: skip
    queue = [EpisodeSpec("2", 3), *(EpisodeSpec(task, seed) for seed in (8, 9) for task in "13")]
    found = evaluated(group_of(3, **fields), queue, retries=0)
    assert [one.spec.task for one in found.failed] == ["2"]
    assert found.failures.total() == 1
    played = sorted((one.spec.task, one.spec.seed) for one in found.played)
    assert played == [("1", 8), ("1", 9), ("3", 8), ("3", 9)]


def test_an_env_that_is_broken_rests_while_others_play() -> None:
    """Each rest is twice as long, so even a machine that takes seconds sees few more failures."""
    makers = [partial(Tasks, breaks={"1": RAISE}), Tasks, Tasks]
    group = sync.build_env_group(makers, envs_per_process=1, max_restarts=99)
    found = evaluated(group, [EpisodeSpec("1", 40 + k) for k in range(60)], retries=0)
    assert {one.env_id for one in found.failed} == {group.env_ids[0]}
    assert 3 <= len(found.failed) <= 12  # Without rests, it takes most episodes.


@pytest.mark.parametrize("on_worker_death", ["restart", "raise"])
def test_all_that_waited_are_charged_an_attempt_where_no_env_is_at_fault(
    on_worker_death: str,
) -> None:
    fields = {"placement": "process", "envs_per_process": 3, "on_worker_death": on_worker_death}
    deeds = [HANG, HANG, DIE_LATER]
    queue = [EpisodeSpec("", seed) for seed in range(3)]
    found = evaluated(
        group_of(3, task=Awaited, **fields),
        queue,
        policy=lambda batch: deeds,
        min_results=3,
        retries=0,
    )
    assert [one.outcome.blame for one in found.failed] == ["infrastructure"] * 3
    assert found.failures == {"env_died": 3}


@pytest.mark.parametrize("together", [1, 2])
def test_deaths_that_are_raised_end_no_evaluation(together: int) -> None:
    """Each is a failure of the episodes that were played in the worker, which is replaced."""
    fields = {
        "env_kwargs": {"breaks": {"2": DIE}}, "placement": "process",
        "on_worker_death": "raise", "envs_per_process": together,
    }  # fmt: skip
    queue = [EpisodeSpec("1", 3), EpisodeSpec("2", 0), EpisodeSpec("3", 9)]
    for num_envs in 4, 2:
        found = evaluated(group_of(num_envs, **fields), queue, retries=3)
        assert [one.spec.task for one in found.failed] == ["2"]
        assert sorted(one.spec.task for one in found.played) == ["1", "3"]


# -- the file -----------------------------------------------------------------------------


def test_an_interrupted_evaluation_resumes_from_its_file(tmp_path: Path) -> None:
    """Episodes in the file aren't played again; others start over, with all their retries."""
    path, subject = tmp_path / "results.jsonl", {"policy": "nothing"}
    breaks = {"env_kwargs": {"breaks": {"2": RAISE}}}
    seen: list[Attempt] = []

    def interrupts(record: Attempt) -> None:
        seen.append(record)
        if len(seen) == 6:
            raise KeyboardInterrupt

    with ResultsFile(path, subject) as results:
        with pytest.raises(KeyboardInterrupt):
            evaluated(group_of(**breaks), results=results, on_episode=interrupts, retries=1)
        with pytest.raises(rl.ConfigError, match="another program is writing this file"):
            ResultsFile(path, subject)
    path.write_text(path.read_text() + '{"entry": "env", "ta')
    with ResultsFile(path, subject) as results:
        assert [*results] == seen
        found = evaluated(group_of(), results=results, retries=1)
    assert sorted(found.attempts[:6], key=str) == sorted(seen, key=str)
    assert len(found.attempts) == len({one.spec.key for one in found.attempts}) == 12
    assert found.failures == Counter(one.kind for early in seen for one in early.failures)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0] == subject
    kept = {(row["task"], row["seed"]): row for row in lines[1:]}
    assert len(kept) == len(lines) - 1 == 12
    outcome = kept["3", 2].pop("outcome")
    assert (outcome["kind"], outcome["blame"]) == ("terminated", "policy")
    assert kept["3", 2] == {
        "entry": "env", "task": "3", "seed": 2, "options": None, "env_id": "", "index": 0,
        "sub_env": 0, "reward": 9.0, "length": 3, "success": True, "failures": [], "rewards": [],
        "columns": {}, "result": None,
    }  # fmt: skip
    with pytest.raises(rl.ConfigError, match=r"belongs to .*nothing.*, not to .*other"):
        ResultsFile(path, {"policy": "other"})


def test_an_open_file_knows_what_was_added_to_it(tmp_path: Path) -> None:
    """An evaluation that was stopped continues within the same `with`."""

    class Enough(Exception):
        """Ends an evaluation."""

    def stops(attempt: Attempt) -> None:
        if attempt.spec.task == "1" and attempt.spec.seed == 3:
            raise Enough

    breaks = {"env_kwargs": {"breaks": {"2": RAISE}}}
    with ResultsFile(tmp_path / "results.jsonl") as results:
        with pytest.raises(Enough):
            evaluated(group_of(**breaks), results=results, on_episode=stops, retries=9)
        assert [*results]
        found = evaluated(group_of(), results=results, retries=9)
        assert len(found.attempts) == len({one.spec.key for one in found.attempts}) == 12
        assert not found.failures
    with ResultsFile(tmp_path / "results.jsonl") as results:
        assert len(results) == 12


class Later(Executor):
    """Writes when somebody waits for it."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        class Written(Future[Any]):
            def result(self, timeout: float | None = None) -> Any:
                if not self.done():
                    self.set_result(fn(*args, **kwargs))
                return super().result(timeout)

        return Written()


def test_what_was_added_just_before_an_evaluation_is_not_played_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file, "new_writer", Later)
    spec = EpisodeSpec("1", 0)
    (played,) = evaluated(group_of(), [spec]).attempts
    with ResultsFile(tmp_path / "results.jsonl") as results:
        results.add(replace(played, length=77))
        (found,) = evaluated(group_of(), [spec], results=results).attempts
        results.add(replace(played, index=1))
        assert results.left().total() == 2  # Which `play` plays first.
    assert found.length == 77


def test_a_line_that_can_not_be_made_is_an_error(tmp_path: Path) -> None:
    """Not of the kind that a full disk is."""
    (played,) = evaluated(group_of(), [EpisodeSpec("1", 0)]).attempts
    nested: list[Any] = []
    for _ in range(100_000):
        nested = [nested]
    results = ResultsFile(tmp_path / "results.jsonl")
    results.add(replace(played, result=nested))
    with pytest.raises(rl.ConfigError, match=r"results\.jsonl.*RecursionError"):
        results.flush()
    with pytest.raises(rl.ConfigError, match="RecursionError"):
        results.close()


def test_a_file_whose_first_line_was_cut_is_begun_again(tmp_path: Path) -> None:
    """Anything else without a whole line is left as it is."""
    path, subject = tmp_path / "results.jsonl", {"policy": "act-1", "seeds": [1, 2]}
    ResultsFile(path, subject).close()
    line = path.read_bytes()
    for length in range(len(line)):
        path.write_bytes(line[:length])
        ResultsFile(path, subject).close()
        assert path.read_bytes() == line
    for foreign in (b"shopping list", line[:-1] + b"}", b" "):
        path.write_bytes(foreign)
        with pytest.raises(rl.ConfigError, match="is not a file of results"):
            ResultsFile(path, subject)
        assert path.read_bytes() == foreign


def test_a_subject_is_compared_as_it_is_read(tmp_path: Path) -> None:
    """JSON has no tuples, and no keys but texts."""
    for _ in range(2):
        ResultsFile(tmp_path / "results.jsonl", {"seeds": (0, 3), "steps": {5: 1}}).close()
    with pytest.raises(rl.ConfigError, match="its subject can't be written as JSON: Object"):
        ResultsFile(tmp_path / "other.jsonl", {"policy": object()})
    assert not (tmp_path / "other.jsonl").exists()


def test_an_outcome_that_an_env_reports_is_of_that_env() -> None:
    """So the episode is tried again on another one."""

    class Gone(Tasks):
        def told(self) -> dict[str, Any]:
            return {"outcome": rl.Outcome("env_away", "infrastructure", "gone")}

    (attempt,) = evaluated(group_of(2, task=Gone), QUEUE[:1]).attempts
    tries = [one.env_id for one in (*attempt.failures, attempt.outcome)]
    assert tries == ["env-0", "env-1", "env-0"]


# -- films --------------------------------------------------------------------------------


class Brighter(Tasks):
    """Its frames say how many steps were made, in a size that most players don't support."""

    metadata: ClassVar[Any] = {"render_fps": 5}

    def render(self) -> Any:
        return np.full((15, 17, 3), STEP * self.steps, np.uint8)


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_the_first_episode_of_each_task_is_filmed(tmp_path: Path, placement: str) -> None:
    """From its reset to its end, whatever other envs do, in any placement."""
    queue = [EpisodeSpec(task, seed) for task in ("1", "2") for seed in (2, 3)]
    found = evaluated(group_of(task=Brighter, placement=placement), queue, video=tmp_path)
    assert len(found.played) == 4
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["env-1-seed-2.mp4", "env-2-seed-2.mp4"]
    for name in names:
        assert brightness(tmp_path / name) == [0, 1, 2, 3]


async def test_films_of_a_number_of_episodes_name_their_env(tmp_path: Path) -> None:
    """Here with `await`, of awaitable envs."""
    entry = {"name": "env", "task": lambda: Awaitable(lambda: Tasks(False)), "placement": "loop"}
    async with rl.build_env_group({**entry, "num_workers": 2}) as group:
        with group.auto_reset(100):
            await evaluate(group, nothing, 2, seed=4, video=tmp_path)
    (path,) = tmp_path.iterdir()  # noqa: ASYNC240
    assert path.name.endswith("seed-4-env-0-episode-0.mp4")
    assert len(brightness(path)) == 6


def test_what_was_lost_before_costs_no_filmed_episode(tmp_path: Path) -> None:
    """The first reset is marked, as an abort has ended what the env did, and is used."""
    with group_of(1) as group:
        group.reset_async()
        group.abort()
        found = evaluate(group, nothing, QUEUE[:1], video=tmp_path)
    assert not found.failures


class Stumbling(Brighter):
    """Its second step does `fault` if `before` is not there, and makes it."""

    def __init__(self, fault: int, before: Path) -> None:
        super().__init__()
        self._fault, self._before = fault, before

    def does(self, action: Any) -> float:
        if self.steps == 2 and not self._before.exists():
            self._before.touch()
            Scripted.does(self, self._fault)
        return super().does(action)


@pytest.mark.parametrize("fault", [RAISE, DIE])
def test_a_lost_episode_leaves_no_film_and_is_filmed_again(tmp_path: Path, fault: int) -> None:
    """A film shows one try, from its reset on."""
    films, make = tmp_path / "films", partial(Stumbling, fault, tmp_path / "before")
    group = group_of(1, placement="process", task=make)
    found = evaluated(group, [EpisodeSpec("1", 3)], video=films)
    assert found.failures.total() == 1
    (path,) = films.iterdir()
    assert brightness(path) == [0, 1, 2, 3, 4]


def test_an_evaluation_that_ends_early_leaves_no_part_of_a_film(tmp_path: Path) -> None:
    """Here the policy raises."""

    def broken(batch: rl.BatchedData) -> Any:
        if not batch.is_reset.any():
            raise ArithmeticError
        return nothing(batch)

    with pytest.raises(ArithmeticError):
        evaluated(group_of(), [EpisodeSpec("1", 3)], policy=broken, video=tmp_path)
    assert not [*tmp_path.iterdir()]


def test_envs_that_render_no_frames_are_refused_before_anything_is_played(tmp_path: Path) -> None:
    """The error names the env and what to do."""

    class Blind(Tasks):
        render_mode = None

    def played(attempt: Attempt) -> None:
        raise AssertionError

    with pytest.raises(ValueError, match="env-0 can't be filmed: its render_mode is None; make it"):
        evaluated(group_of(task=Blind), video=tmp_path, on_episode=played)
    assert not [*tmp_path.iterdir()]


def test_films_of_an_entry_whose_name_is_a_path_stay_in_their_folder(tmp_path: Path) -> None:
    """Nothing is written outside of it."""
    evaluated(group_of(name="../mine"), QUEUE[:1], video=tmp_path / "films")
    assert [path.name for path in tmp_path.iterdir()] == ["films"]
    assert [path.suffix for path in (tmp_path / "films").iterdir()] == [".mp4"]


@pytest.mark.parametrize("limit", [1, 2, 9])
def test_episodes_that_a_step_limit_cuts_are_filmed(tmp_path: Path, limit: int) -> None:
    """The limit is the trainer's, so the film is still open when the episode ends."""
    with group_of() as group, group.auto_reset(limit):
        found = evaluate(group, nothing, QUEUE[:4], video=tmp_path)
    lengths = sorted(record.length or 0 for record in found.attempts)
    assert lengths == [min(k, limit) for k in (1, 2, 3, 4)]
    cut = [one.outcome.cause for one in found.attempts if one.outcome.kind == "truncated"]
    assert all("step limit" in cause for cause in cut)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["env-1-seed-0.mp4"]


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


# -- what is refused ---------------------------------------------------------------------


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
