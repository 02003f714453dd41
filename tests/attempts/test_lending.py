"""Envs that are lent to a trainer's own loop: a reset is tried again by the rule of `Rules`."""

from __future__ import annotations

import asyncio

import pytest
from attempts.rooms import PLACES, rooms
from patience import HANG

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


async def test_an_env_comes_back_although_its_return_is_cancelled() -> None:
    """As where a time limit strikes while what another one has cut is being ended."""
    async with rooms(PLACES["loop"], num_workers=1) as group:
        lending = Lending(group, retries=0)
        episode = await lending.begin(seed=1)
        assert isinstance(episode, AttemptInPlay)
        step = asyncio.create_task(episode.step("hang"))
        while not group.pending:  # noqa: ASYNC110  # It is sent in a later turn.
            await asyncio.sleep(0)
        step.cancel()
        await asyncio.wait({step})
        ending = asyncio.create_task(lending.end(episode))
        await asyncio.sleep(0)
        ending.cancel()
        await asyncio.wait({ending})
        assert ending.cancelled()
        async with asyncio.timeout(HANG):
            again = await lending.begin(seed=2)
        assert isinstance(again, AttemptInPlay)


async def test_a_seed_that_is_refused_takes_no_env() -> None:
    async with rooms(PLACES["loop"], num_workers=1) as group:
        lending = Lending(group, retries=0)
        with pytest.raises(ValueError, match="the seed"):
            await lending.begin(seed=-1)
        assert lending.idle == 1
