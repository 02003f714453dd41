"""``on_worker_death: resume``: envs of a replaced worker continue from their last checkpoint."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any, TypeAlias

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation
from kit.driven import Driven, on_one_driver
from kit.processes import kill, kill_first_worker
from kit.scripted import Counts

from rlightning_aio.config import parse_configs
from rlightning_aio.errors import ConfigError, EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


class Walk(Counts):
    """A random walk: each value depends on all previous ones."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    length = 30

    def does(self, action: Any) -> float:
        self.at += self.np_random.normal() * (1 + action)
        self.over = bool(self.np_random.random() < 0.05)
        return self.at

    def observed(self) -> Any:
        if not self.steps:
            self.at = self.np_random.normal()
        return np.array([self.steps, self.at])

    def told(self) -> dict[str, Any]:
        return {"steps": self.steps}


NUM_DEATHS = int(os.environ.get("RLIGHTNING_AIO_DEATHS", "4"))
ENTRY: dict[str, Any] = {
    "name": "e",
    "task": Walk,
    "num_workers": 4,
    "envs_per_process": 2,
    "on_worker_death": "resume",
    "snapshot_every": 5,
    "max_restarts": 20,
}


def actions(observation: Any) -> list[int]:
    """Return actions that depend only on observations, so they don't depend on lost steps."""
    return [int(own[1] * 1000) % 2 for own in observation]


class Episodes:
    """Steps a group for a number of episodes of each env, and records their ends."""

    def __init__(self, group: Any) -> None:
        self.group = group
        self.ended: dict[str, list[tuple[float, int]]] = {
            env_id: [] for env_id in group.group.env_ids
        }
        self.lost: list[int] = []
        self.batch, _ = group.reset(seed=3)

    def run(self, num_episodes: int, strike: Callable[[], bool] = lambda: False) -> None:
        """Step until each env has ended that often and no kill is pending."""
        with self.group.auto_reset(100):
            while strike() or min(map(len, self.ended.values())) < num_episodes:
                request = self.batch.respond(action=actions(self.batch.observation))
                self.batch, _ = self.group.step(request)
                for env_id, info in zip(self.batch.ids(), self.batch.info(), strict=True):
                    if "episode" in info:
                        self.ended[env_id].append((info["episode"]["r"], info["episode"]["l"]))
                    if "worker_resumed" in info:
                        assert "worker_restarted" in info
                        self.lost.append(info["worker_resumed"])


def with_deaths(start: Start, num_episodes: int, num_deaths: int) -> Episodes:
    """Return the episodes of a run in which one of the workers is killed at random turns."""
    draw = np.random.default_rng(1)
    group = start(ENTRY)
    left = num_deaths

    def strike() -> bool:
        nonlocal left
        before = left
        workers = group.get_workers()
        pid = workers[draw.integers(len(workers))]["pid"]
        if left and draw.random() < 0.15 and pid is not None:
            kill(pid)
            left -= 1
        return before > 0  # One more step after the last death, which reports it.

    episodes = Episodes(group)
    episodes.run(num_episodes, strike)
    return episodes


@on_one_driver
@pytest.mark.timeout(300 + NUM_DEATHS)
def test_episodes_after_deaths_have_the_returns_of_a_run_without(
    start: Start,
) -> None:
    """At most the entry's `snapshot_every` steps are lost at once. ``RLIGHTNING_AIO_DEATHS`` is the
    number of deaths.
    """
    disturbed = with_deaths(start, 5, NUM_DEATHS)
    undisturbed = Episodes(start({**ENTRY, "on_worker_death": "restart", "snapshot_every": None}))
    undisturbed.run(max(map(len, disturbed.ended.values())))
    assert any(disturbed.lost)
    assert max(disturbed.lost) <= ENTRY["snapshot_every"]
    for env_id, episodes in disturbed.ended.items():
        assert episodes == undisturbed.ended[env_id][: len(episodes)]


def test_a_resumed_env_reports_the_number_of_lost_steps(start: Start) -> None:
    """Its result repeats that of the checkpoint: no transition, no new episode, the same info."""
    group = start({**ENTRY, "num_workers": 2, "on_worker_death": "resume"})
    shown = []
    with group.auto_reset(100):
        batch, _ = group.reset(seed=3)
        for _ in range(7):
            batch, _ = group.step(batch.respond(action=[0, 0]))
            shown.append(batch)
        kill_first_worker(group)
        again, flags = group.step(batch.respond(action=[0, 0]))
        assert again.restarted.all()
        assert again.is_reset.all()
        assert flags == [False, False]
        np.testing.assert_equal(again.observation, shown[4].observation)
        assert [info["worker_resumed"] for info in again.info()] == [2, 2]
        assert [info["steps"] for info in again.info()] == [5, 5]
        assert not any("episode" in info for info in again.info())
        for old in shown[5:]:
            again, _ = group.step(again.respond(action=[0, 0]))
            np.testing.assert_equal(again.observation, old.observation)
            assert not again.is_reset.any()


@on_one_driver
def test_a_step_limit_does_not_count_lost_steps(start: Start) -> None:
    """They are made again, and the limit comes after as many steps as without the death."""
    group = start({**ENTRY, "num_workers": 1, "task": Straight})
    batch, _ = group.reset(seed=3)
    lengths = []
    with group.auto_reset(12):
        for turn in range(40):
            if turn in (8, 21):
                kill_first_worker(group)
            batch, _ = group.step(batch.respond(action=[0]))
            lengths += [info["episode"]["l"] for info in batch.info() if "episode" in info]
            assert bool(batch.limit_reached[0]) == ("episode" in batch.info()[0])
    assert lengths == [12, 12]


@on_one_driver
def test_wrappers_and_generators_are_resumed(start: Start) -> None:
    """Running means are restored, whatever request was in progress at the death."""
    entry = {**ENTRY, "task": Averaged, "num_workers": 1, "snapshot_every": 1}
    runs = []
    for deaths in ((), (4, 11, 13)):
        group = start(entry)
        batch, _ = group.reset(seed=5)
        seen = []
        for turn in range(16):
            if turn in deaths:
                kill_first_worker(group)
                if turn != 11:
                    batch, _ = group.step(batch.respond(action=[1]))
                    assert batch.info()[0]["worker_resumed"] == 0
            batch, _ = group.reset() if turn in (5, 11) else group.step(batch.respond(action=[1]))
            seen.append(batch.observation)
        runs.append(seen)
    np.testing.assert_equal(runs[1], runs[0])


@on_one_driver
def test_a_restored_env_resumes_from_the_restored_state(start: Start) -> None:
    """A death after a restore doesn't bring back the state before it."""
    group = start({**ENTRY, "num_workers": 1, "task": Straight, "snapshot_every": 50})
    batch, _ = group.reset(seed=3)
    for _ in range(3):
        batch, _ = group.step(batch.respond(action=[0]))
    snapshot = group.snapshot()
    for _ in range(20):
        batch, _ = group.step(batch.respond(action=[0]))
    batch, _ = group.restore(snapshot)
    batch, _ = group.step(batch.respond(action=[0]))
    kill_first_worker(group)
    batch, _ = group.step(batch.respond(action=[0]))
    assert batch.observation[0][0] == 3
    assert batch.info()[0]["worker_resumed"] == 1


@on_one_driver
def test_a_snapshot_of_an_env_that_was_taken_back_is_of_one_moment(start: Start) -> None:
    """State, info and counters are those of the checkpoint, also in its marked result."""
    entry = {**ENTRY, "num_workers": 2, "task": Straight, "snapshot_every": 4}
    group = start(entry)
    batch, _ = group.reset(seed=3)
    with group.group.auto_reset(10):
        for _ in range(7):
            batch, _ = group.step(batch.respond(action=[0, 0]))
        kill_first_worker(group)
        batch, _ = group.step(batch.take([0]).respond(action=[0]))
        assert batch.info()[0]["worker_resumed"] == 3
        for snapshot in (group.snapshot(["e-0"]), group.snapshot(["e-1"])):
            batch, _ = group.restore(snapshot, ["e-1"])
            assert (batch.observation[0][0], batch.info()) == (4, [{"steps": 4}])
            for step in range(5, 11):
                batch, at_limit = group.step(batch.respond(action=[0]))
                assert batch.observation[0][0] == step
                assert at_limit == [step == 10]
            assert batch.info()[0]["episode"]["l"] == 10


class Straight(Walk):
    """Never ends by itself."""

    def step(self, action: Any) -> Any:
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


class Averaged(NormalizeObservation):
    def __init__(self) -> None:
        super().__init__(Straight())


@on_one_driver
def test_an_env_without_checkpoints_raises_at_its_first_reset(
    build: Callable[..., Driven],
) -> None:
    """Not only at the first death."""
    group = build({**ENTRY, "task": Locked, "num_workers": 1})
    group.init()
    with pytest.raises(EnvRaised, match=r"raised in reset: .*env\.env\.lock of env 'e-0'"):
        group.reset()


class Locked(Straight):
    def __init__(self) -> None:
        self.lock = threading.Lock()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"snapshot_every": None}, "snapshot_every: is required with on_worker_death: resume"),
        ({"on_worker_death": "restart"}, "snapshot_every: has no meaning without"),
        ({"placement": "inline", "envs_per_process": 1}, "no worker that could die"),
        (
            {"backend": "piper", "task": "x"},
            "can't restore what backend 'piper'",
        ),
    ],
)
def test_entries_that_cannot_be_resumed_are_refused(fields: dict[str, Any], message: str) -> None:
    """Before anything starts, with the field."""
    with pytest.raises(ConfigError, match=message):
        parse_configs({**ENTRY, **fields})
