"""`GroupContract`: an env in a group behaves as it does alone, in any placement."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from kit.contract import EnvContract, Expected, outcomes_of, same, values_of

from rlightning_aio import BatchedData, PolicyResponse, sync

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

NO_LIMIT = 10**6


# Here, episodes end by the limits of the envs.
@pytest.mark.filterwarnings("ignore:.*overrides the limits")
class GroupContract(EnvContract):
    """The tests of `EnvContract`, and the same env in worker processes and inline."""

    @pytest.mark.parametrize("placement", ["process", "inline"])
    def test_an_env_in_a_group_behaves_as_alone(self, placement: str) -> None:
        """Each env has its spaces, and the exact trajectory of its seed."""
        with self.opened() as env:
            actions = self.actions(env)
            spaces = env.get_observation_space(), env.get_action_space()
            seeds = self.seed, self.seed + self.config.num_envs
            alone = [list(outcomes_of(env, actions, seed)) for seed in seeds]
        config = self.config.model_copy(update={"placement": placement, "num_workers": 2})
        with sync.build_env_group(config) as group:
            assert group.get_observation_spaces() == [spaces[0]] * 2
            assert group.get_action_spaces() == [spaces[1]] * 2
            together = list(batches(group, self.seed, actions))
        for k, outcomes in enumerate(alone):
            for index, (batch, outcome) in enumerate(zip(together, outcomes, strict=True)):
                result = batch.values()[k]
                assert same_outcome(values_of(result), outcome), (
                    f"env {k}, outcome {index}: {result} is not {outcome}"
                )


def batches(group: sync.EnvGroup, seed: int, actions: Sequence[Any]) -> Iterator[BatchedData]:
    """Yield the results of a group for a seeded reset and for one step with each action, of all
    envs.
    """
    yield group.reset(seed=seed)[0]
    with group.auto_reset(max_episode_steps=NO_LIMIT):
        for action in actions:
            responses = [PolicyResponse(env_id, action) for env_id in group.env_ids]
            yield group.step(BatchedData(group.env_ids, responses))[0]


def same_outcome(one: Expected, other: Expected) -> bool:
    """Return True if two outcomes are equal; missing values equal any."""
    return same(one[0], other[0]) and all(map(_same_column, one[1:], other[1:]))


def _same_column(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return same(one, other)
    return np.array_equal(*np.broadcast_arrays(one, other))
