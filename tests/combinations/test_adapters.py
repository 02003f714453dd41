"""`VectorEnv` and `sb3.VecEnv` over the options of their group, against one list for each env."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from combinations.options import HERE, PLACEMENTS, SEED, pairwise
from combinations.played import TASKS, Transition, act, as_tuple, played
from gymnasium.vector import AutoresetMode

from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable

NUM_ENVS = 3
FACTORS: dict[str, tuple[Any, ...]] = {
    "mode": ("next_step", "same_step", "disabled"),
    "placement": HERE,
    "copy": (True, False),
    "task": tuple(TASKS),
    "limit": (math.inf, 4),
}


@dataclass(frozen=True)
class Row:
    """What a row of envs is made with."""

    mode: str
    placement: str
    copy: bool
    task: str
    limit: float

    @property
    def fits(self) -> bool:
        """All go together."""
        return True

    @property
    def autoreset_mode(self) -> AutoresetMode:
        return AutoresetMode[self.mode.upper()]

    def makers(self) -> list[Callable[[], Any]]:
        """One callable for each env."""
        return [TASKS[self.task]] * NUM_ENVS

    def entry(self) -> dict[str, Any]:
        """The fields of the group's entry."""
        fields: dict[str, Any] = {**PLACEMENTS[self.placement]}
        if self.limit != math.inf:
            fields["max_episode_steps"] = self.limit
        return fields

    def check(self, lists: list[list[Transition]], at_least: int) -> None:
        """Compare lists with what the envs must have done, each in its own time."""
        assert len(lists) == NUM_ENVS
        assert min(map(len, lists)) >= at_least
        for k, own in enumerate(lists):
            (expected,) = played(self.task, "disabled", [SEED + k], self.limit, len(own))
            assert own == expected[: len(own)]


ROWS = pairwise(Row, FACTORS)


def ids(row: Row) -> str:
    return "-".join(map(str, vars(row).values()))


@pytest.mark.parametrize("row", ROWS, ids=ids)
def test_vector_env(row: Row) -> None:
    """As a loop stores it that knows Gymnasium's modes, and nothing of groups."""
    lists: list[list[Transition]] = [[] for _ in range(NUM_ENVS)]
    first, over = np.ones((2, NUM_ENVS), np.bool_)
    over[:] = False
    envs = VectorEnv(row.makers(), copy=row.copy, autoreset_mode=row.autoreset_mode, **row.entry())
    try:
        observation, _ = envs.reset(seed=SEED)
        for _ in range(20):
            before, kept = [*map(as_tuple, observation)], observation
            actions = act(row.task, observation)
            observation, *columns, infos = envs.step(actions)
            if row.copy:
                assert [*map(as_tuple, kept)] == before
            for k, (reward, terminated, truncated) in enumerate(zip(*columns, strict=True)):
                if over[k] and row.mode == "next_step":
                    over[k] = False
                    continue
                over[k] = terminated or truncated
                at_once = over[k] and row.mode == "same_step"
                after = infos["final_obs"][k] if at_once else observation[k]
                ends = bool(terminated), bool(truncated)
                lists[k].append(
                    Transition(
                        before[k], as_tuple(actions[k]), float(reward), *ends, as_tuple(after),
                        bool(first[k]),
                    )
                )  # fmt: skip
                first[k] = over[k]
            if row.mode == "disabled" and over.any():
                stood = [*map(as_tuple, observation)]
                observation, _ = envs.reset(options={"reset_mask": over.copy()})
                for k in np.flatnonzero(~over):
                    assert as_tuple(observation[k]) == stood[k]
                over[:] = False
    finally:
        envs.close()
    row.check(lists, 10)


@pytest.mark.simulators
@pytest.mark.parametrize("row", [row for row in ROWS if row.mode == "same_step"], ids=ids)
def test_sb3_vec_env(row: Row) -> None:
    """As Stable-Baselines3 stores it: the last observation of an episode is in the info."""
    lists: list[list[Transition]] = [[] for _ in range(NUM_ENVS)]
    first = [True] * NUM_ENVS
    envs = import_module("rlightning_aio.sb3").VecEnv(row.makers(), **row.entry())
    try:
        envs.seed(SEED)
        observation = envs.reset()
        for _ in range(20):
            before, actions = [*map(as_tuple, observation)], act(row.task, observation)
            observation, rewards, dones, infos = envs.step(actions)
            for k, (reward, done, info) in enumerate(zip(rewards, dones, infos, strict=True)):
                after = info["terminal_observation"] if done else observation[k]
                cut = info["TimeLimit.truncated"]
                lists[k].append(
                    Transition(
                        before[k], as_tuple(actions[k]), float(reward), bool(done and not cut),
                        cut, as_tuple(after), first[k],
                    )
                )  # fmt: skip
                first[k] = bool(done)
    finally:
        envs.close()
    # Stable-Baselines3 counts a termination at the limit as a termination alone.
    row.check(lists, 10)
