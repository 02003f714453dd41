"""Envs that are lent to a trainer's own loop: a reset is tried again by the rule of `Rules`."""

from __future__ import annotations

import asyncio

import pytest
from attempts.rooms import PLACES, rooms

from rlightning_aio.attempts.episode import AttemptInPlay
from rlightning_aio.attempts.lending import Lending
from rlightning_aio.outcomes import Outcome


@pytest.mark.parametrize(("deed", "tries"), [("raise", 3), ("blame", 1)])
async def test_a_reset_is_tried_again_unless_the_policy_is_to_blame(deed: str, tries: int) -> None:
    async with rooms(PLACES["loop"]) as group:
        found = await Lending(group, retries=2).begin(options={"reset": deed})
        assert isinstance(found, Outcome)
        assert found.kind == "not_started"
        assert group.metrics()["envs/outcomes_not_started"] == tries


async def test_the_death_of_another_env_uses_up_no_retry() -> None:
    """Both are in one worker, which dies in the reset of the first."""
    async with rooms(PLACES["shared workers"], num_workers=2) as group:
        lending = Lending(group, retries=0)
        died, other = await asyncio.gather(
            lending.begin(options={"reset": "die"}), lending.begin(seed=3)
        )
        assert isinstance(died, Outcome)
        assert died.kind in ("env_died", "not_started")
        assert isinstance(other, AttemptInPlay)
        assert other.first["seed"] == 3
        await lending.end_all()
