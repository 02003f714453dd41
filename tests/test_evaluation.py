"""`evaluate`: an equal number of episodes of each env, and unbiased statistics."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.errors import EnvBusy
from rlightning_aio.evaluation import Episode, EpisodeSpec, Evaluation, evaluate, outcomes
from rlightning_aio.evaluation.estimates import Estimate, mean_estimate, wilson_estimate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

SHORT, LONG = 2, 8


class Scripted(gym.Env[Any, Any]):
    """Succeeds soon or fails late, as ``succeeds`` says for the seed of the episode.

    Its reward is 1 in each step; action 1 ends its process.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, succeeds: Callable[[int], bool], key: str = "success") -> None:
        self._succeeds, self._key = succeeds, key
        self._seed = self._steps = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._seed = seed
        self._steps = 0
        return np.array([self._seed], np.float64), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action == 1:
            os._exit(3)
        self._steps += 1
        success = self._succeeds(self._seed)
        over = self._steps == (SHORT if success else LONG)
        observation = np.array([self._seed], np.float64)
        return observation, 1.0, over, False, {self._key: success and over}


class Patient(SyncVectorEnv):
    """Steps envs whose episode has ended, until all are reset, if none is reset by itself."""

    def step(self, actions: Any) -> Any:
        if self.metadata["autoreset_mode"] is AutoresetMode.DISABLED:
            self._autoreset_envs[:] = False
        return super().step(actions)


def group_of(*makers: Callable[[], Any], **fields: Any) -> sync.EnvGroup:
    fields = {"placement": "inline", **fields}
    entry = {"name": "env", "task": list(makers), "num_workers": len(makers), **fields}
    return sync.build_env_group(entry)


def nothing(batch: rl.BatchedData) -> Any:
    return np.zeros(batch.is_reset.shape, np.int64)


def scripted(succeeds: Callable[[int], bool], **kwargs: Any) -> Callable[[], Scripted]:
    return lambda: Scripted(succeeds, **kwargs)


def evaluated(group: sync.EnvGroup, episodes: int, **kwargs: Any) -> Evaluation:
    with group, group.auto_reset(1000):
        return evaluate(group, kwargs.pop("policy", nothing), episodes, **kwargs)


def first_come(group: sync.EnvGroup, total: int) -> list[bool]:
    """Return the success of the episodes that end first."""
    found: list[bool] = []
    with group, group.auto_reset(1000):
        batch, _ = group.reset()
        while len(found) < total:
            batch, _ = group.step(batch.respond(action=nothing(batch)))
            found += batch.info("success", False)[batch.done].tolist()
    return found[:total]


HALF_SUCCEED = [scripted(lambda _: True)] * 2 + [scripted(lambda _: False)] * 2


def test_a_fixed_number_of_each_is_unbiased_where_first_come_is_not() -> None:
    """Half of the envs succeed, in 2 + 1 calls; the others fail in 8 + 1. Of the episodes that end
    first, three in four succeed.
    """
    assert np.mean(first_come(group_of(*HALF_SUCCEED), 24)) == 0.75
    found = evaluated(group_of(*HALF_SUCCEED), 6)
    assert found.success is not None
    assert (found.success.mean, found.success.count) == (0.5, 24)
    assert found.length is not None
    assert found.length.mean == (SHORT + LONG) / 2


def test_the_first_episodes_are_unbiased_where_first_come_is_not() -> None:
    """In all envs, three in ten episodes succeed; the first three to end all succeed."""
    envs = [scripted(lambda seed: seed % 10 < 3)] * 10
    with (group := group_of(*envs)), group.auto_reset(1000):
        batch, _ = group.reset(seed=0)
        while not batch.done.any():
            batch, _ = group.step(batch.respond(action=nothing(batch)))
        assert batch.info("success")[batch.done].tolist() == [True] * 3
    found = evaluated(group_of(*envs), 4, seed=0)
    assert found.success is not None
    assert (found.success.mean, found.success.count) == (0.3, 40)


def by_number(episodes: Sequence[Episode]) -> list[Episode]:
    return sorted(episodes, key=lambda one: (one.env_id, one.sub_env, one.number))


def test_episodes_are_listed() -> None:
    """Each with its env, number, return and length, and values of its last info."""
    listed: list[Episode] = []
    group = group_of(scripted(lambda seed: seed % 2 == 0, key="is_success"))
    found = evaluated(group, 2, seed=4, on_episode=listed.append)
    assert found.episodes == listed
    assert listed == [
        Episode("env-0", 0, 0, float(SHORT), SHORT, True),
        Episode("env-0", 0, 1, float(LONG), LONG, False),
    ]


@pytest.mark.parametrize("mode", [None, AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_episode_n_has_its_own_seed(mode: AutoresetMode | None) -> None:
    """``seed + n * N + k``, with N sub-environments in the group, in any order of ends; if
    sub-environments reset themselves, the seed is that of the first.
    """
    seen: set[int] = set()

    def notes(batch: rl.BatchedData) -> Any:
        seen.update(np.ravel(batch.observation).astype(int).tolist())
        return nothing(batch)

    make = scripted(lambda seed: seed % 2 == 0)
    own = make if mode is None else lambda: SyncVectorEnv([make] * 2, autoreset_mode=mode)
    found = evaluated(group_of(own, own), 3, seed=10, policy=notes)
    width = 1 if mode is None else 2
    rounds = 3 if mode is None else 1
    assert seen == set(range(10, 10 + rounds * 2 * width))
    counts = {(one.env_id, one.sub_env): 0 for one in found.episodes}
    assert len(counts) == 2 * width
    for one in found.episodes:
        key = one.env_id, one.sub_env
        assert one.number == counts[key]
        counts[key] += 1
        success = one.success
        assert one.length == one.total_reward == (SHORT if success else LONG)
    assert set(counts.values()) == {3}


def test_a_resumed_evaluation_equals_an_uninterrupted_one() -> None:
    """Finished episodes aren't played again."""
    envs = [scripted(lambda seed: seed % 3 == 0)] * 3
    whole = evaluated(group_of(*envs), 4, seed=5)
    kept: list[Episode] = []

    def interrupts(episode: Episode) -> None:
        kept.append(episode)
        if len(kept) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluated(group_of(*envs), 4, seed=5, on_episode=interrupts)
    added: list[Episode] = []
    rest = evaluated(group_of(*envs), 4, seed=5, played=kept, on_episode=added.append)
    assert len(added) == 12 - 5
    assert by_number(rest.episodes) == by_number(whole.episodes)


def test_an_episode_that_is_lost_with_its_worker_is_repeated() -> None:
    """With its seed, so the statistics equal those without a death."""
    calls = 0

    def dies_once(batch: rl.BatchedData) -> Any:
        nonlocal calls
        calls += 1
        return np.full(len(batch), calls == 4)

    env = scripted(lambda seed: seed % 2 == 0)
    group = group_of(env, placement="process")
    found = evaluated(group, 3, seed=0, policy=dies_once)
    assert found.lost == 1
    assert [one.length for one in found.episodes] == [SHORT, LONG, SHORT]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_first_of_two_episodes_to_end_is_not_repeated(mode: AutoresetMode) -> None:
    """A worker that is lost in between begins again with the one that is missing."""
    calls = 0

    def dies_once(batch: rl.BatchedData) -> Any:
        nonlocal calls
        calls += 1
        return nothing(batch) | (calls == 5)

    make = scripted(lambda seed: seed in (0, 3))
    both = lambda: Patient([make] * 2, autoreset_mode=mode)  # noqa: E731
    whole = evaluated(group_of(both), 2, seed=0)
    assert [one.length for one in by_number(whole.episodes) if one.number == 0] == [SHORT, LONG]
    found = evaluated(group_of(both, placement="process"), 2, seed=0, policy=dies_once)
    assert found.lost
    assert by_number(found.episodes) == by_number(whole.episodes)
    rest = evaluated(group_of(both), 2, seed=0, played=whole.episodes[:1])
    assert by_number(rest.episodes) == by_number(whole.episodes)


@pytest.mark.parametrize("together", [1, 2])
def test_an_env_that_always_ends_its_worker_is_an_error(together: int) -> None:
    """It would never finish its episodes. Another env of its worker is not blamed."""
    env = scripted(lambda _: True)
    group = group_of(env, env, placement="process", envs_per_process=together, max_restarts=10)

    def ends_the_second(batch: rl.BatchedData) -> Any:
        return np.array([env_id == "env-1" for env_id in batch.env_ids()], np.int64)

    with pytest.raises(rl.RLightningError, match=r"'env-1' has lost .* 3 times in a row"):
        evaluated(group, 3, policy=ends_the_second)


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
    assert [len(found.of_envs([id_]).episodes) for id_ in ("pair-0", "single-0")] == [4, 2]


async def test_it_is_awaited_over_an_asynchronous_group() -> None:
    """The policy may be awaitable, too."""

    async def policy(batch: rl.BatchedData) -> Any:
        return nothing(batch)

    entry = {"name": "env", "task": scripted(lambda _: True), "placement": "inline"}
    async with rl.build_env_group(entry) as group:
        with group.auto_reset(1000):
            found = await evaluate(group, policy, np.int64(2))
    assert len(found.episodes) == 2


# -- errors -----------------------------------------------------------------------------


def test_a_group_with_steps_in_flight_is_refused_with_what_to_do() -> None:
    """A Collector leaves some after a rollout; an evaluation needs another group."""
    with (group := group_of(*HALF_SUCCEED[:2])), group.auto_reset(9):
        batch, _ = group.reset()
        group.step_async(batch.take([1]).respond(action=nothing(batch)[1:]))
        # An evaluation that plays only env 0 would take the result of env 1 for its own.
        played = [Episode("env-1", 0, 0, 1.0, 1, None)]
        for episodes, options in ((1, {"played": played}), ([EpisodeSpec("", 0)], {})):
            with pytest.raises(EnvBusy, match="second group of the same entries"):
                evaluate(group, nothing, episodes, **options)
        group.collect_async()


def test_it_resets_envs_at_their_ends_by_itself() -> None:
    """At the limits of the open context, or else at their own, if they have any."""
    for limit, lengths in ((None, {SHORT, LONG}), (5, {SHORT, 5})):
        for episodes in (2, [EpisodeSpec("", seed) for seed in range(8)]):
            with group_of(*HALF_SUCCEED, max_episode_steps=limit) as group:
                found: Any = evaluate(group, nothing, episodes)
                played = found.records if isinstance(episodes, list) else found.episodes
                assert len(played) == 8
                assert {episode.length for episode in played} == lengths
                with group.auto_reset(limit or 3):  # None is open.
                    found = evaluate(group, nothing, 1)
                assert {episode.length for episode in found.episodes} == {SHORT, limit or 3}


def test_an_episode_that_may_never_end_is_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, in both forms: evaluate would wait for it for ever."""
    monkeypatch.setattr(outcomes, "_LONG", 5)
    for episodes in (2, [EpisodeSpec("", seed) for seed in range(8)]):
        caplog.clear()
        with group_of(*HALF_SUCCEED) as group:
            evaluate(group, nothing, episodes)
        (record,) = caplog.records
        assert record.levelname == "WARNING"
        assert "an episode of env 'env-2' has made 5 steps" in record.getMessage()


def test_it_needs_its_own_envs() -> None:
    """This is checked before anything is sent."""
    with group_of(scripted(lambda _: True)) as group, group.auto_reset(9):
        with pytest.raises(ValueError, match="episodes must be at least 1, not 0"):
            evaluate(group, nothing, 0)
        with pytest.raises(ValueError, match="max_attempts is for a queue of episodes"):
            evaluate(group, nothing, 1, max_attempts=2)  # type: ignore[call-overload]
        other = Episode("other-0", 0, 0, 1.0, 1, None)
        with pytest.raises(ValueError, match=r"'other-0'.* was not played by an env of this group"):
            evaluate(group, nothing, 1, played=[other])


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
        (Estimate(float("nan"), None, None, 4), "nan (n=4)"),
    ],
)
def test_an_estimate_prints_what_is_known(estimate: Estimate, printed: str) -> None:
    assert str(estimate) == printed
