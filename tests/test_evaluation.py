"""`evaluate`: an equal number of episodes of each env, and unbiased statistics."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from kit.scripted import DIE, GO, HANG, Scripted

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.attempts.records import attempt_of
from rlightning_aio.errors import EnvBusy
from rlightning_aio.evaluation import EpisodeSpec, Evaluation, ResultsFile, evaluate
from rlightning_aio.evaluation.estimates import Estimate, mean_estimate, wilson_estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


SHORT, LONG = 2, 8


class Succeeding(Scripted):
    """Succeeds soon or fails late, as ``succeeds`` says for the seed of the episode.

    Action 1 ends its process, and action 2 never ends.
    """

    def __init__(self, succeeds: Callable[[int], bool], key: str = "success") -> None:
        self._succeeds, self._key, self._seed = succeeds, key, 0

    def does(self, action: Any) -> None:
        self.length = SHORT if self._succeeds(self._seed) else LONG
        super().does({1: DIE, 2: HANG}.get(int(action), GO))

    def observed(self) -> Any:
        self._seed = self._seed if self.seed is None else self.seed
        return np.array([self._seed], np.float64)

    def told(self) -> dict[str, Any]:
        return {self._key: self.over and self.length == SHORT} if self.steps else {}


def group_of(*makers: Callable[[], Any], **fields: Any) -> sync.EnvGroup:
    fields = {"placement": "inline", **fields}
    entry = {"name": "env", "task": list(makers), "num_workers": len(makers), **fields}
    return sync.build_env_group(entry)


def nothing(batch: rl.BatchedData) -> Any:
    return np.zeros(batch.is_reset.shape, np.int64)


def scripted(succeeds: Callable[[int], bool], **kwargs: Any) -> Callable[[], Succeeding]:
    return lambda: Succeeding(succeeds, **kwargs)


def evaluated(group: sync.EnvGroup, episodes: Any, **kwargs: Any) -> Evaluation:
    with group, group.auto_reset(1000):
        return evaluate(group, kwargs.pop("policy", nothing), episodes, **kwargs)


HALF_SUCCEED = [scripted(lambda _: True)] * 2 + [scripted(lambda _: False)] * 2


def test_a_fixed_number_of_each_is_unbiased() -> None:
    """Half of the envs succeed soon, and the others fail late."""
    found = evaluated(group_of(*HALF_SUCCEED), 6)
    assert found.success is not None
    assert (found.success.mean, found.success.count) == (0.5, 24)
    assert found.length is not None
    assert found.length.mean == (SHORT + LONG) / 2


def by_number(found: Evaluation) -> list[tuple[Any, ...]]:
    """What came of each episode, by env, sub-environment and number."""
    return sorted(
        (one.env_id, one.sub_env, one.index, one.reward, one.length, one.success)
        for one in found.attempts
    )


def test_the_first_of_two_episodes_to_end_is_not_repeated(tmp_path: Path) -> None:
    """A worker that is lost in between begins again with the one that is missing."""
    calls = 0

    def dies_once(batch: rl.BatchedData) -> Any:
        nonlocal calls
        calls += 1
        return nothing(batch) | (calls == 5)

    make = scripted(lambda seed: seed in (0, 3))
    both = lambda: SyncVectorEnv([make] * 2)  # noqa: E731
    with ResultsFile(tmp_path / "one.jsonl") as results:
        whole = evaluated(group_of(both), 2, seed=0)
        assert [one[4] for one in by_number(whole) if one[2] == 0] == [SHORT, LONG]
        results.add(whole.attempts[0])
        found = evaluated(group_of(both, placement="process"), 2, seed=0, policy=dies_once)
        assert found.failures
        assert by_number(found) == by_number(whole)
        rest = evaluated(group_of(both), 2, seed=0, results=results)
    assert by_number(rest) == by_number(whole)


@pytest.mark.parametrize("together", [1, 2])
def test_episodes_of_an_env_that_always_ends_its_worker_fail(
    together: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Those of another env of its worker are played, and the log says it once."""
    env = scripted(lambda _: True)
    group = group_of(env, env, placement="process", envs_per_process=together, max_restarts=20)

    def ends_the_second(batch: rl.BatchedData) -> Any:
        return np.array([env_id == "env-1" for env_id in batch.env_ids()], np.int64)

    found = evaluated(group, 2, policy=ends_the_second, retries=1)
    assert [(one.env_id, one.index) for one in found.failed] == [("env-1", 0), ("env-1", 1)]
    assert [one[:3] for one in by_number(Evaluation(found.played))] == [
        ("env-0", 0, 0),
        ("env-0", 0, 1),
    ]
    assert found.failures == {"env_died": 4}
    said = [one.getMessage() for one in caplog.records if "has failed" in one.getMessage()]
    assert len(said) == 1
    assert "exited with code 3" in said[0]


def test_what_was_lost_before_it_costs_no_episode() -> None:
    """The first reset of each env is marked, as an abort has ended what it did, and is used."""
    with group_of(*[scripted(lambda seed: seed % 2 == 0)] * 2) as group:
        group.reset_async()
        group.abort()
        found = evaluated(group, 2)
        assert [one.failures for one in found.attempts] == [()] * 4
        assert not found.failed
        assert group.metrics()["envs/results"] == sum(one.length + 1 for one in found.attempts)


def test_entries_may_differ() -> None:
    """In their observations and their number of sub-environments; a policy may answer with several
    batches.
    """
    pair = {
        "name": "pair", "placement": "inline",
        "task": lambda: SyncVectorEnv([scripted(lambda _: True)] * 2),
    }  # fmt: skip
    single = {"name": "single", "placement": "inline", "task": scripted(lambda _: False)}

    def by_entry(batch: rl.BatchedData) -> list[rl.BatchedData]:
        return [part.respond(action=nothing(part)) for part in batch.by_entry().values()]

    found = evaluated(sync.build_env_group([pair, single]), 2, policy=by_entry)
    assert Counter(one.env_id for one in found.attempts) == {"pair-0": 4, "single-0": 2}


def test_entries_of_different_spaces_have_a_policy_each() -> None:
    """Each is called with the results of its entry alone; one may be a model, or random."""
    tasks = {"cart": "CartPole-v1", "car": "MountainCar-v0", "bar": "Pendulum-v1"}
    entries = [
        {"name": name, "backend": "gymnasium", "task": task, "placement": "inline"}
        for name, task in tasks.items()
    ]
    shapes = set[tuple[int, ...]]()

    class Model:
        def predict(self, observation: Any, **_: Any) -> Any:
            shapes.add(observation.shape)
            return np.zeros(len(observation), np.int64), None

    def swing(batch: rl.BatchedData) -> Any:
        shapes.add(batch.observation.shape)
        return np.zeros((len(batch), 1), np.float32)

    policies = {"cart": Model(), "bar": swing, "car": None}
    with sync.build_env_group(entries, mixed_actions=True) as group, group.auto_reset(5):
        found = evaluate(group, policies, 2, seed=0)
        assert Counter(one.env_id for one in found.attempts) == {f"{name}-0": 2 for name in tasks}
        assert shapes == {(1, 4), (1, 3)}
        del policies["car"]
        with pytest.raises(ValueError, match=r"no policy was given for .* 'car'.* cart, bar"):
            evaluate(group, policies, 2)
        assert group.pending == []


def test_it_is_printed_as_a_table() -> None:
    """With a line for each task, and one for all."""
    found = evaluated(group_of(*HALF_SUCCEED), [EpisodeSpec("", seed) for seed in range(8)])
    head, line = str(found).splitlines()
    assert head.split() == ["task", "episodes", "success", "return", "length", "failed"]
    assert line.split()[1] == "8"


@pytest.mark.parametrize(
    ("told", "success", "words"),
    [
        (None, None, ""),
        (np.nan, None, "leaves out 4 whose success is NaN of 4 episodes: 0.0%"),
        ([1, np.nan, np.inf, 0], 0.5, "leaves out 2 whose success is NaN of 4 episodes: 25.0%"),
        ([0.7, 0.2, 1.0, 0.0], 0.5, "a value above 0.5; the mean of the values is 0.475"),
        ([1, None, None, 1], 1.0, "out 2 with no success in the last info of 4 episodes: 50"),
    ],
)  # fmt: skip
def test_what_counts_as_a_success_is_said(told: Any, success: float | None, words: str) -> None:
    """NaN is a failed verdict, a share counts above one half, and what is left out is named."""
    values = np.broadcast_to(np.array(told, object), 4).tolist()

    def judged(k: int) -> Callable[[], Succeeding]:
        env = scripted(lambda _: True)()
        env.told = lambda: {} if values[k] is None else {"success": values[k]}
        return lambda: env

    found = evaluated(group_of(*map(judged, range(4))), 1)
    assert (found.success and found.success.mean) == success
    assert words in str(found)
    assert bool(words) == bool(found.remarks)
    again = Evaluation(
        [attempt_of(json.loads(json.dumps(one.to_json()))) for one in found.attempts]
    )
    assert (again.success, again.success_value) == (found.success, found.success_value)


def test_a_success_rate_says_that_failed_episodes_are_left_out() -> None:
    """Those that end soon succeed; longer ones have failed more often."""

    def late(seed: int) -> bool:
        if seed == 3:
            raise ConnectionError("the simulator is gone")
        return True

    group = group_of(scripted(late), on_env_error="restart")
    found = evaluated(group, [EpisodeSpec("", seed) for seed in range(4)], retries=0)
    assert found.success is not None
    assert (found.success.mean, len(found.failed)) == (1.0, 1)
    assert str(found).endswith("leaves out 1 failed of 4 episodes: 75.0% if they count as failures")


# -- errors -----------------------------------------------------------------------------


def test_a_group_with_steps_in_flight_is_refused_with_what_to_do() -> None:
    """A Collector leaves some after a rollout; an evaluation needs another group."""
    with (group := group_of(*HALF_SUCCEED[:2])), group.auto_reset(9):
        batch, _ = group.reset()
        group.step_async(batch.take([1]).respond(action=nothing(batch)[1:]))
        for episodes in (1, [EpisodeSpec("", 0)]):
            with pytest.raises(EnvBusy, match="second group of the same entries"):
                evaluate(group, nothing, episodes)
        group.collect_async()


def test_a_step_that_takes_too_long_for_an_evaluation_that_has_ended_is_aborted() -> None:
    """Its episode is no loss of the next one."""
    hanging = False

    def fails(batch: rl.BatchedData) -> Any:
        nonlocal hanging
        if hanging:
            raise RuntimeError("no memory")
        hanging = "env-0" in batch.env_ids()
        return [2 if env_id == "env-0" else 0 for env_id in batch.env_ids()]

    with group_of(*HALF_SUCCEED[:2], placement="process") as group:
        with pytest.raises(RuntimeError, match="no memory"):
            evaluate(group, fails, 1000, seed=0, min_results=1)  # So one env plays on meanwhile.
        assert group.pending == []
        found = evaluate(group, nothing, 2, seed=0)
    assert len(found.played) == 4
    assert not found.failures


# -- statistics -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [
        (0, 10, 0.0, 0.2775),
        (10, 10, 0.7225, 1.0),
        (8, 10, 0.4902, 0.9433),
        (81, 263, 0.2553, 0.3662),
    ],
)
def test_wilson_interval(successes: int, count: int, low: float, high: float) -> None:
    """Calculated by hand with z = 1.96: (p + z²/2n ± z √(p(1-p)/n + z²/4n²)) / (1 + z²/n); the last
    case is Newcombe's example (Statistics in Medicine 17, 1998).
    """
    found = wilson_estimate(successes, count)
    assert found is not None
    assert (found.low, found.high) == pytest.approx((low, high), abs=5e-5)


def test_interval_of_a_mean() -> None:
    """Of 1, 2, 3, 4: 2.5 ± 3.182 · 1.29099 / 2; larger tables have 2.0860 at 20 degrees
    of freedom.
    """
    found = mean_estimate([1.0, 2.0, 3.0, 4.0])
    assert found is not None
    assert (found.mean, found.low, found.high) == pytest.approx((2.5, 0.44603, 4.55397), abs=1e-4)
    wide = mean_estimate([float(k) for k in range(21)])
    assert wide is not None
    assert wide.high == pytest.approx(10 + 2.08596 * np.sqrt(38.5 / 21), abs=1e-3)


def test_what_nothing_is_known_of() -> None:
    """No episode has no figures; one has a mean alone."""
    empty = Evaluation()
    assert empty.total_reward is empty.length is empty.success is None
    assert str(empty).splitlines()[1].split() == ["all", "0", "-", "-", "-", "0"]
    one = mean_estimate([3.0])
    assert one is not None
    assert (one.mean, one.low, one.high) == (3.0, None, None)


@pytest.mark.parametrize(
    ("estimate", "printed"),
    [
        (Estimate(4.876, 4.281, 5.471, 80), "4.88 [4.28, 5.47] (n=80)"),
        (Estimate(1234.5, 1199.2, 1269.8, 9), "1234 [1199, 1270] (n=9)"),
        (Estimate(0.0123, 0.0119, 0.0127, 9), "0.01230 [0.01190, 0.01270] (n=9)"),
        (Estimate(500.0, 500.0, 500.0, 3), "500.00 [500.00, 500.00] (n=3)"),
        (Estimate(7.0, None, None, 1), "7 (n=1)"),
    ],
)
def test_an_estimate_prints_what_is_known(estimate: Estimate, printed: str) -> None:
    assert str(estimate) == printed
