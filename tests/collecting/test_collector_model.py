"""Compares a collector, with results in random order, with the logs of its envs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from collecting.scripted import Disturbed, Step, Tickets, scripted_group
from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.collecting import Collector, Rollout

if TYPE_CHECKING:
    from collections.abc import Callable


class Model:
    """Compares the collected transitions of each env with its log."""

    def __init__(self, logs: dict[int, list[Step]], tickets: Tickets) -> None:
        self.logs = logs
        self.tickets = tickets
        self.collected = dict.fromkeys(logs, 0)

    def check(self, rollout: Rollout, version: int) -> None:
        rows = len(rollout.shape)

        def flat(name: str) -> Any:
            return rollout[name].reshape(len(rollout), *rollout[name].shape[rows:])

        after = rollout.next_observation.reshape(len(rollout), -1)
        numbers = np.arange(len(rollout)).reshape(rollout.shape)
        if rows == 1:
            chains = np.split(numbers, np.flatnonzero(np.diff(rollout.index)) + 1)
        else:
            chains = list(numbers.T)
        assert rollout.num_chains == len(chains)
        assert rollout.ends[: len(chains)].tolist() == [chain[-1] for chain in chains]
        over: dict[int, list[tuple[float, int, float, bool]]] = {}
        ends = set(rollout.ends.tolist())
        assert len(ends) == len(rollout.ends)
        for chain in chains:
            env = int(flat("index")[chain[0]])
            log = self.logs[env][self.collected[env] :][: len(chain)]
            assert len(log) == len(chain)
            self.collected[env] += len(chain)
            for k, row in enumerate(chain.tolist()):
                step = log[k]
                assert flat("index")[row] == env
                assert flat("observation")[row].tolist() == step.before
                assert flat("action")[row].item() == step.action == flat("log_prob")[row]
                assert flat("reward")[row] == step.reward
                assert flat("terminated")[row] == step.terminated
                assert flat("truncated")[row] == step.truncated
                assert flat("done")[row] == (step.terminated or step.truncated)
                assert flat("first")[row] == (step.before[2] == 0)
                assert after[row].tolist() == step.after
                assert flat("acted")[row] == step.action
                odd = step.after[2] % 2 == 1
                np.testing.assert_equal(flat("odd")[row], 1.0 if odd else np.nan)
                if flat("done")[row]:
                    rewards = [s.reward for s in self.logs[env] if s.before[1] == step.before[1]]
                    over.setdefault(env, []).append((sum(rewards), len(rewards), step.action, odd))
                assert flat("policy_version")[row] == self.tickets.version_of[step.action]
                followed = k + 1 < len(chain) and not flat("first")[chain[k + 1]]
                assert (row in ends) == (not followed)
        ended: dict[int, list[tuple[float, int, float, bool]]] = {}
        for index, total, length, info in zip(*rollout.episodes.values(), strict=True):
            told = info["acted"], bool(info.get("odd", False))
            ended.setdefault(index, []).append((total, length, *told))
        assert ended == over
        ages = version - flat("policy_version")
        assert (flat("lag") == ages).all()

    def uncollected(self) -> set[float]:
        """Tickets of all steps that are in no rollout."""
        rests = (log[self.collected[env] :] for env, log in self.logs.items())
        return {step.action for rest in rests for step in rest}


def tickets_of(batch: Any) -> set[float]:
    if batch.is_reset.all():
        return set()
    return set(batch.sent.log_prob[~batch.is_reset].tolist())


def until_full(collect: Callable[[], Rollout]) -> Rollout:
    while True:
        try:
            return collect()
        except InterruptedError:
            continue


def chance_of(draw: Any, generator: Any, most: float) -> Callable[[], bool]:
    share = draw(st.sampled_from([0.0, most / 4, most]))
    return lambda: generator.random() < share


@given(st.data(), st.sampled_from(["single", "same_step", "vector", "same_step_vector"]))
@pytest.mark.parametrize("block", [False, True])
def test_every_transition_is_in_one_rollout_in_order(block: bool, data: Any, kind: str) -> None:
    """Also the observation after each end, for any order of results, losses and interruptions."""
    if block and kind == "vector":
        return  # See test_collector.py.
    draw = data.draw
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    num_envs = draw(st.integers(1, 5))
    group, logs = scripted_group(kind, num_envs, draw(st.sampled_from([0.0, 0.1, 0.5, 1.0])))
    tickets = Tickets(chance_of(draw, generator, 0.2))
    with group, group.auto_reset(math.inf):
        disturbed: Any = Disturbed(
            group,
            logs,
            choose=lambda count: int(generator.integers(count)),
            loses=chance_of(draw, generator, 0.3),
            interrupts=chance_of(draw, generator, 0.3),
        )
        total = draw(st.integers(1, 12)) * (len(logs) if block else 1)
        options: Any = {"wait_all": True} if block else {"min_results": draw(st.integers(1, 5))}
        options["infos"] = ("acted", "odd")
        collector: Any = Collector(disturbed, tickets, num_transitions=total, **options)
        tickets.version = lambda: collector.policy_version
        model = Model(logs, tickets)
        for _ in range(4):
            rollout = until_full(collector.collect)
            assert len(rollout) == total
            assert rollout.shape == ((total // len(logs), len(logs)) if block else (total,))
            model.check(rollout, collector.policy_version)
            collector.policy_version += int(generator.integers(3))
            left = model.uncollected()
            in_flight = {t for row in disturbed.pool for t in tickets_of(row)}
            assert left <= in_flight | tickets_of(disturbed.last)
            assert in_flight <= left
            if block:
                assert not left
