"""Steps of agents that are sent together: none notices what the others do, or what is done to them.

tests/hosts/test_loop.py tests agents that leave, and who is woken.
"""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from kit.scripted import DIE, END, GO, HANG, RAISE, Awaited, Scripted

import rlightning_aio as rl
from rlightning_aio._core.group.api.episode import outcome_of
from rlightning_aio._core.group.engine import agent_steps
from rlightning_aio._core.group.state.request_states import State
from rlightning_aio.errors import BadAction, EnvRaised, EpisodeLost, GroupClosed, WorkerDied

PLACES = [{"placement": "inline"}, {"envs_per_process": 2}]
pytestmark = pytest.mark.timeout(60)


class Counter(Scripted):
    """Reports how many steps it has made."""

    def told(self) -> dict[str, Any]:
        return {"count": self.steps}


class Long(Awaited):
    """Steps end one soon after another, but for those that don't."""

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0.05 + 0.01 * int(action))
        return await super().step(action)


async def episodes(group: Any) -> list[Any]:
    return [await group.episode(env_id).__aenter__() for env_id in group.env_ids]


async def stepped(playing: list[Any], actions: list[Any]) -> list[Any]:
    """The outcomes of steps that are asked for in one turn of the loop."""
    steps = [one.step(action) for one, action in zip(playing, actions, strict=True)]
    return await asyncio.gather(*steps, return_exceptions=True)


@pytest.mark.parametrize("place", PLACES, ids=["inline", "workers"])
async def test_only_the_agent_with_a_bad_action_gets_an_error(place: dict[str, Any]) -> None:
    """Its env was not stepped, and goes on."""
    async with rl.build_env_group(Counter, num_workers=4, **place) as group:
        playing = await episodes(group)
        for bad, said in ((np.ones(3), "expected shape"), ("north", "is not an array|expected")):
            found = await stepped(playing, [GO, bad, GO, GO])
            assert isinstance(found[1], BadAction)
            with pytest.raises(BadAction, match=said):
                raise found[1]
            assert [ret.env_id for ret in found if not isinstance(ret, BadAction)] == [
                one.env.env_id for one in playing if one is not playing[1]
            ]
        found = await stepped(playing, [GO] * 4)
        assert [ret.info["count"] for ret in found] == [3, 1, 3, 3]


class Picky(Counter):
    """Its observation is the seed; refuses an odd one, and says which options it was given."""

    def observed(self) -> Any:
        if self.seed is not None and self.seed % 2:
            raise ArithmeticError
        return np.array([self.seed or 0.0])

    def told(self) -> Any:
        return {"options": self.options} if self.options else super().told()


async def begun(starts: list[Any]) -> list[Any]:
    """The first results, or the errors, of episodes that begin in one turn of the loop."""

    async def first(episode: Any) -> Any:
        return (await episode.__aenter__()).last

    return await asyncio.gather(*map(first, starts), return_exceptions=True)


@pytest.mark.parametrize("place", PLACES, ids=["inline", "workers"])
async def test_episodes_that_begin_together_have_their_own_seeds_options_and_errors(
    place: dict[str, Any],
) -> None:
    async with rl.build_env_group(Picky, num_workers=6, **place) as group:
        given: list[Any] = [(2, None), (3, None), (None, None), (4, {"a": 1}), (-1, None), (6, 7)]
        found = await begun(
            [group.episode(e, *one) for e, one in zip(group.env_ids, given, strict=True)]
        )
        assert isinstance(found[1], EnvRaised)
        assert [found[k].observation.tolist() for k in (0, 2, 3)] == [[2], [0], [4]]
        assert found[1].env_id == group.env_ids[1]
        assert found[3].info == {"options": {"a": 1}}
        assert isinstance(found[4], ValueError)
        assert isinstance(found[5], TypeError)
        assert group.pending == []
        assert len(await begun([group.episode(env_id, 8) for env_id in group.env_ids])) == 6
        found = await stepped(await episodes(group), [GO] * 6)
        assert [ret.info["count"] for ret in found] == [1] * 6


async def test_a_seed_that_is_no_int_is_refused_even_an_empty_one() -> None:
    async with rl.build_env_group(Counter, num_workers=1, placement="inline") as group:
        (found,) = await begun([group.episode(group.env_ids[0], "")])
        assert isinstance(found, ValueError)


async def test_an_episode_whose_worker_dies_in_its_reset_is_lost() -> None:
    """Its first result is that of a replacement, which has not got its seed."""
    async with rl.build_env_group(Counter, num_workers=1) as group:
        async with group.episode(group.env_ids[0], 5, {"deed": DIE}) as episode:
            assert episode.is_over
            assert episode.lost is not None
            assert episode.lost.kind == "env_died"
            with pytest.raises(EpisodeLost, match="is lost: its env exited with code 3"):
                await episode.step(GO)
        async with group.episode(group.env_ids[0], 5) as episode:
            assert (episode.is_over, episode.lost) == (False, None)


async def test_each_agent_has_its_own_error_of_a_worker_that_is_not_replaced() -> None:
    fields: dict[str, Any] = {"envs_per_process": 2, "on_worker_death": "raise"}
    async with rl.build_env_group(Counter, num_workers=4, **fields) as group:
        playing = await episodes(group)
        found = await stepped(playing, [DIE, GO, GO, GO])
        assert [type(ret) is WorkerDied for ret in found] == [True, True, False, False]
        assert found[0] is not found[1]
        assert [found[2].info["count"], found[3].info["count"]] == [1, 1]


async def test_a_step_that_is_cancelled_before_it_is_sent_is_not_sent() -> None:
    async with rl.build_env_group(Counter, num_workers=2, placement="inline") as group:
        first, other = await episodes(group)
        cancelled = asyncio.ensure_future(first.step(GO))
        going_on = asyncio.ensure_future(other.step(GO))
        await asyncio.sleep(0)
        cancelled.cancel()
        assert (await going_on).info["count"] == 1
        assert (await first.step(GO)).info["count"] == 1


async def test_all_agents_learn_that_the_group_is_closed() -> None:
    """Those whose steps were sent, and those whose steps were not."""
    group = rl.build_env_group(Awaited, num_workers=3, placement="loop")
    await group.init()
    playing = await episodes(group)
    steps = [asyncio.ensure_future(one.step(HANG)) for one in playing[:2]]
    while len(group.pending) < 2:  # noqa: ASYNC110  # Twice.
        await asyncio.sleep(0)
    closing = asyncio.ensure_future(group.close())
    found = await asyncio.gather(*steps, playing[2].step(GO), return_exceptions=True)
    assert [type(error) for error in found] == [GroupClosed] * 3
    await closing


async def test_agents_and_batches_and_calls_take_turns() -> None:
    """Whoever waits for the hosts, each gets the results of its own envs."""
    async with rl.build_env_group(Counter, num_workers=6, envs_per_process=2) as group:
        playing = [await group.episode(env_id).__aenter__() for env_id in group.env_ids[:2]]
        batch, _ = await group.reset(env_ids=group.env_ids[2:4])

        async def agent(one: Any) -> int:
            for _ in range(30):
                found = await one.step(GO)
            return found.info["count"]

        async def called(env_id: str) -> None:
            await group[env_id].set_attr("mark", env_id)
            for _ in range(20):
                assert await group[env_id].get_attr("mark") == env_id

        async def collected() -> int:
            found = batch
            for _ in range(30):
                group.step_async(found.respond(action=np.zeros(2, np.int64)))
                found, _ = await group.collect_async(wait_all=True)
                assert found.ids() == group.env_ids[2:4]
            return int(found.observation.sum())

        calls = map(called, group.env_ids[4:])
        counts = await asyncio.gather(*map(agent, playing), collected(), *calls)
        assert counts == [30, 30, 60, None, None]


def pause(monkeypatch: pytest.MonkeyPatch, *, share: float, longest: float, many: int) -> None:
    """Have results wait for others, as hundreds of long steps do."""
    for name, value in (("_SHARE", share), ("_LONGEST_PAUSE", longest), ("_MANY", many)):
        monkeypatch.setattr(agent_steps, name, value)


class Cancelling(Awaited):
    """Has its agent cancelled a turn of the loop before the step ends that ends the episode."""

    agent: asyncio.Task[Any]

    async def step(self, action: Any) -> Any:
        result = await super().step(action)
        if action == END:
            Cancelling.agent.cancel()
            await asyncio.sleep(0)
        return result


@pytest.mark.parametrize("action", [GO, END], ids=["waits for others", "comes"])
async def test_an_agent_that_leaves_while_its_result_waits_or_comes_frees_its_env(
    monkeypatch: pytest.MonkeyPatch, action: int
) -> None:
    """So that it can be reset at once."""

    async def agent(episode: Any, action: int) -> None:
        try:
            await episode.step(action)
        finally:
            await episode.__aexit__()

    async with rl.build_env_group(Cancelling, num_workers=2, placement="loop") as group:
        first, other = await episodes(group)
        pause(monkeypatch, share=1000, longest=30, many=2)
        going_on = asyncio.ensure_future(agent(other, HANG))
        leaving = Cancelling.agent = asyncio.ensure_future(agent(first, action))
        if action == GO:
            while group._core.tables.requests.state[0] != State.READY:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
            assert not leaving.done()
            leaving.cancel()
        await asyncio.wait([leaving])
        await group.reset(env_ids=group.env_ids[:1])
        going_on.cancel()
        await asyncio.wait([going_on])


@pytest.mark.parametrize("action", [GO, RAISE], ids=["result", "error"])
async def test_what_ends_in_the_turn_of_a_cancellation_is_left_to_collect(action: int) -> None:
    """The call of all handles finds it before the cancelled task runs again."""
    async with rl.build_env_group(Counter, placement="inline") as group:
        await group.reset()
        task = asyncio.ensure_future(group[group.env_ids[0]].step(action))
        ended = group._core.agent_steps._hand_out

        def cancelled_first(ticket: Any) -> bool:
            if ticket.ended:
                task.cancel()
            return ended(ticket)

        group._core.agent_steps._hand_out = cancelled_first  # type: ignore[method-assign]
        await asyncio.wait([task])
        assert task.cancelled()
        assert group.pending == group.env_ids
        if action == RAISE:
            with pytest.raises(EnvRaised):
                await group.collect_async()
        else:
            batch, _ = await group.collect_async()
            assert batch.info()[0]["count"] == 1
        assert group.pending == []


@pytest.mark.parametrize("place", [{"placement": "loop"}, {}], ids=["loop", "workers"])
async def test_a_step_that_is_aborted_as_its_task_is_cancelled_is_for_nobody(
    place: dict[str, Any],
) -> None:
    """The task runs again only after the abort has ended its step."""
    async with rl.build_env_group(Long, num_workers=3, **place) as group:
        await group.reset()
        steps = [asyncio.ensure_future(group[env_id].step(0)) for env_id in group.env_ids]
        while len(group.pending) < 3:  # noqa: ASYNC110
            await asyncio.sleep(0)
        steps[0].cancel()
        await group.abort(group.env_ids[:1])
        rets = await asyncio.gather(*steps[1:])
        assert [ret.env_id for ret in rets] == group.env_ids[1:]
        assert group.pending == []
        group.reset_async()
        batch, _ = await group.collect_async(wait_all=True)
        assert batch.ids() == group.env_ids


@pytest.mark.parametrize("is_timeout", [False, True])
async def test_a_reply_that_is_there_before_a_cancellation_is_returned(is_timeout: bool) -> None:
    """The cancellation comes where the task waits next, unless a timeout has taken it back."""
    loop = asyncio.get_running_loop()
    reply: asyncio.Future[str] = loop.create_future()
    seen: list[str] = []

    async def main() -> None:
        if is_timeout:
            loop.call_soon(reply.set_result, "reply")
            async with asyncio.timeout(0):
                seen.append(await outcome_of(reply))
            await asyncio.sleep(0.01)
        else:
            seen.append(await outcome_of(reply))
            await asyncio.sleep(30)

    task = asyncio.ensure_future(main())
    await asyncio.sleep(0)
    if not is_timeout:
        reply.set_result("reply")
        task.cancel()
    await asyncio.wait([task])
    assert (seen, task.cancelled()) == (["reply"], not is_timeout)
