"""Ctrl-C at any moment of a synchronous collect: the next one asks for a restart."""

from __future__ import annotations

import contextlib
import math
import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from collecting.test_interruptions import parts_of
from faults.striking import struck

from rlightning_aio import sync
from rlightning_aio.collecting import Collector, Rollout
from rlightning_aio.errors import NothingPending, ResetNeeded

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.batch import BatchedData

SEED = 7
PER_ENTRY = ("fast", "slow")
STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "97"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 9000
"""More lines than a collect executes."""


class Uneven(gym.Env[Any, Any]):
    """Shows [steps of the episode, a number that depends on all before]; episodes are short."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps, self.length, self.at = 0, *self.np_random.integers((1, 0), (8, 1000)).tolist()
        return np.array([0.0, self.at]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.at = (7 * self.at + 3 * int(action[0]) + int(self.np_random.integers(1000))) % 1009
        over, odd = self.steps >= self.length, bool(self.length % 2)
        observation = np.array([float(self.steps), self.at])
        return observation, float(self.at % 100), over and odd, over and not odd, {}


def policy(batch: BatchedData) -> dict[str, Any]:
    return {"action": batch.observation[:, 1:] % 5, "seen": batch.observation}


def check(found: list[Rollout]) -> None:
    """Each env has made its first transitions, each once and in order, as it does alone."""
    alone: dict[int, tuple[Uneven, Any]] = {}
    for rollout in found:
        after = rollout.next_observation
        for place in np.ndindex(rollout.shape):
            index = int(rollout.index[place])
            if index not in alone:
                env = Uneven()
                alone[index] = env, env.reset(seed=SEED + index)[0]
            env, before = alone[index]
            assert rollout.observation[place].tolist() == before.tolist(), f"env {index}"
            assert rollout.seen[place].tolist() == before.tolist()
            assert rollout.first[place] == (before[0] == 0)
            shown, reward, *ends, _ = env.step(before[1:] % 5)
            assert after[place].tolist() == shown.tolist()
            assert rollout.reward[place] == reward
            assert [rollout.terminated[place], rollout.truncated[place]] == ends
            alone[index] = env, env.reset()[0] if any(ends) else shown


@pytest.fixture(scope="module")
def group() -> Iterator[sync.EnvGroup]:
    """Two entries, each with two envs in one worker."""
    entry = {"task": Uneven, "envs_per_process": 2, "num_workers": 2}
    with sync.build_env_group([{**entry, "name": name} for name in PER_ENTRY]) as group:
        yield group


def collect_from_all(collector: Any, found: list[Rollout]) -> None:
    """Add rollouts until there are five, and transitions of each env."""
    while len(found) < 5 or len({*np.concatenate([one.index.flat for one in found])}) < 4:
        found += parts_of(collector.collect())


@pytest.mark.parametrize("call", ["first", "third"])
@pytest.mark.parametrize("kind", ["first ready", "blocks"])
def test_a_collector_can_be_restarted_wherever_it_was_interrupted(
    group: sync.EnvGroup, kind: str, call: str, pressed_again: list[bool]
) -> None:
    """Nothing that the interrupted call had half done comes back."""
    options = {"num_transitions": 8, "wait_all": True} if kind == "blocks" else {}
    for line in range(1, NUM_LINES, STRIDE):
        num_calls, found = [0], list[Rollout]()

        def counted(batch: BatchedData, num_calls: list[int] = num_calls) -> dict[str, Any]:
            num_calls[0] += 1
            return policy(batch)

        policies = dict.fromkeys(PER_ENTRY, counted)
        with group.auto_reset(math.inf):
            collector: Any = Collector(
                group, policies, seed=SEED, **{"num_transitions": 3, **options}
            )
            for _ in range(2 if call == "third" else 0):
                found += parts_of(collector.collect())
            before = num_calls[0]
            reached, interrupted, rollout = struck(line, collector.collect)
            has_ended = interrupted and num_calls[0] > before
            if rollout is not None:
                found += parts_of(rollout)
            assert len(pressed_again) == (reached and not interrupted)
            pressed_again.clear()
            try:
                found += parts_of(collector.collect())
            except ResetNeeded:
                assert reached
                found, has_ended = [], False
                collector.restart(SEED)
            collect_from_all(collector, found)
        if not has_ended:  # Where a line ends the call, Python looks for no signals.
            check(found)
        with contextlib.suppress(NothingPending):
            while True:
                group.collect_async(wait_all=True)
        if not reached:
            break
    else:
        pytest.fail(f"a collect executes more than {NUM_LINES} lines")
