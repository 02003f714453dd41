"""Groups of attempts: retries, completeness, time limits, cancellation, resumption."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import math
import os
import threading
import time
import tracemalloc
from collections import Counter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from attempts.room import AwaitedRoom
from attempts.rooms import PLACES, rooms
from kit.counting import ClientThread, CountingEnv, served
from patience import HANG

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.attempts import Attempt, EpisodeSpec, ResultsFile, Rules, play
from rlightning_aio.attempts.health import Health
from rlightning_aio.attempts.records import success_of
from rlightning_aio.attempts.rules import is_unnamed
from rlightning_aio.errors import EnvBusy, EpisodeLost
from rlightning_aio.outcomes import Loss

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rlightning_aio.attempts import AttemptEpisode, AttemptGroup


pytestmark = pytest.mark.one_driver_for_each_place


def tasks(count: int, **options: Any) -> list[EpisodeSpec]:
    return [EpisodeSpec("", seed, options or None) for seed in range(count)]


async def earner(episode: AttemptEpisode) -> str:
    """Earn the seed in each step."""
    while not episode.is_over:
        await episode.step(episode.last.observation["seed"], tokens=[episode.index])
    return f"room {episode.spec.seed}"


async def played(*args: Any, **kwargs: Any) -> list[AttemptGroup]:
    return [found async for found in play(*args, **kwargs)]


async def test_each_task_is_attempted_as_often_as_asked(place: dict[str, Any]) -> None:
    async with rooms(place) as group:
        found = await played(group, tasks(6), earner, size=3)
        assert group.pending == []
    assert sorted(attempts.spec.seed for attempts in found) == [*range(6)]
    for attempts in found:
        seed = attempts.spec.seed
        assert attempts.is_complete
        assert [attempt.index for attempt in attempts] == [0, 1, 2]
        assert attempts.rewards == [5.0 * seed] * 3
        for attempt in attempts:
            assert (attempt.outcome.kind, attempt.outcome.blame) == ("terminated", "policy")
            assert attempt.columns == {"action": [seed] * 5, "tokens": [[attempt.index]] * 5}
            assert (attempt.length, attempt.result) == (5, f"room {seed}")
            assert (attempt.first["steps"], attempt.last["steps"]) == (0, 5)
            assert attempt.env_id in group.env_ids


async def test_what_the_policy_is_to_blame_for_is_not_tried_again(place: dict[str, Any]) -> None:
    async def agent(episode: AttemptEpisode) -> None:
        await episode.step("blame")

    async with rooms(place) as group:
        ((attempt,),) = await played(group, tasks(1), agent)
    assert (attempt.outcome.kind, attempt.outcome.blame) == ("env_raised", "policy")
    assert attempt.failures == ()


def client_error(package: str, name: str, base: str = "", **attributes: Any) -> Exception:
    """An error as a client raises it, which needs not be installed."""
    bases = (type(base, (Exception,), {"__module__": package}),) if base else (Exception,)
    return type(name, bases, {"__module__": package, **attributes})("as a client has it")


def caused_by(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "blame"),
    [
        (ConnectionError("the model is away"), "infrastructure"),
        (KeyError("a bug"), "caller"),
        (FileNotFoundError("the prompt"), "caller"),
        (client_error("openai", "APIConnectionError"), "infrastructure"),
        (client_error("httpx", "ReadTimeout", "TransportError"), "infrastructure"),
        (client_error("aiohttp.client_exceptions", "ServerDisconnected"), "caller"),
        (client_error("openai", "APIStatusError", status_code=429), "infrastructure"),
        (client_error("aiohttp", "ClientResponseError", status=503), "infrastructure"),
        (client_error("openai", "RateLimitError", status_code=400), "caller"),
        (caused_by(RuntimeError("no answer"), ConnectionError("refused")), "infrastructure"),
        (rl.EnvError("its reply can't be read", blame="policy"), "policy"),
    ],
)
async def test_an_agent_that_raises(error: Exception, blame: str) -> None:
    async def agent(episode: AttemptEpisode) -> None:
        if episode.spec.seed == 0:  # If the first one failed, it would be the end.
            await earner(episode)
            done.set()
            return
        await episode.step(1)
        await done.wait()
        raise error

    done = asyncio.Event()

    async with rooms(PLACES["loop"]) as group:
        tried = await played(group, tasks(2), agent, 1, Rules(retries=1))
    attempt = next(one for (one,) in tried if one.spec.seed == 1)
    assert (attempt.outcome.kind, attempt.outcome.blame) == ("agent_raised", blame)
    assert len(attempt.failures) == (blame == "infrastructure")


@pytest.mark.parametrize(
    ("steps", "deed", "on_timeout", "kind", "blame", "reward"),
    [
        (1, "think", "fail", "timed_out", "either", None),
        (1, "think", "end", "truncated", "policy", 1.0),
        (0, "think", "end", "timed_out", "either", None),
        (5, "think", "end", "terminated", "policy", 5.0),
        (2, "hang", "end", "env_hung", "either", None),
        (2, "raise", "fail", "env_raised", "either", None),
        (2, "raise", "end", "env_raised", "either", None),
        (0, "finish", "fail", "truncated", "policy", 7.0),
        (2, "finish", "end", "truncated", "policy", 7.0),
        (5, "finish", "fail", "terminated", "policy", 7.0),
    ],
)
async def test_an_agent_that_takes_too_long(
    steps: int, deed: str, on_timeout: Any, kind: str, blame: str, reward: float | None
) -> None:
    """Nothing to grade is no end, and what was earned counts for nothing if the env is lost. An
    agent that has finished has its reward.
    """

    async def agent(episode: AttemptEpisode) -> None:
        for _ in range(steps):
            await episode.step(1)
        if deed == "finish":
            episode.finish(7)
        elif deed != "think":
            with contextlib.suppress(rl.EnvRaised):
                await episode.step(deed)
            with pytest.raises(rl.RLightningError, match="has failed"):  # Nothing can mend that.
                await episode.step(1)
        thinking.append(time.monotonic())
        await asyncio.sleep(3600)

    thinking: list[float] = []
    rules = Rules(attempt_timeout=1.0, on_timeout=on_timeout, retries=0)
    async with rooms(PLACES["loop"]) as group:
        began = time.monotonic()
        ((attempt,),) = await played(group, tasks(1), agent, 1, rules)
    assert (attempt.outcome.kind, attempt.outcome.blame) == (kind, blame)
    assert (attempt.reward, attempt.length) == (reward, steps)
    if deed != "hang":
        assert attempt.outcome.seconds.agent > began + 1.0 - thinking[0]


@pytest.mark.parametrize("what", ["a step", "a step that was not sent", "a call"])
async def test_what_an_agent_leaves_to_a_task_of_its_own_ends_with_the_attempt(what: str) -> None:
    """As by `asyncio.wait` with a time limit, or `asyncio.shield`; the next attempt has the env."""

    async def agent(episode: AttemptEpisode) -> None:
        asked = episode.call("stall") if what == "a call" else episode.step("hang")
        left.append(asyncio.create_task(asked))
        await asyncio.sleep(0)
        if what != "a step that was not sent":
            while not group.pending:  # noqa: ASYNC110  # It is sent in a later turn.
                await asyncio.sleep(0)

    left: list[asyncio.Task[Any]] = []
    async with rooms(PLACES["loop"], num_workers=1) as group:
        found = await played(group, tasks(3), agent, 1, Rules(retries=0))
        assert group.pending == []
        await asyncio.wait(left)
    assert [attempt.outcome.kind for (attempt,) in found] == ["agent_stopped"] * 3
    for task in left:
        assert task.cancelled() or isinstance(task.exception(), EpisodeLost)


async def test_the_surplus_is_cancelled_into_the_env(place: dict[str, Any]) -> None:
    """The first two of four make a group; the others' steps end with it."""
    if place is PLACES["inline"] or place is PLACES["shared workers"]:
        pytest.skip("a step that hangs keeps its neighbours waiting")

    async def agent(episode: AttemptEpisode) -> None:
        if episode.index % 2:
            await episode.step("hang")
        await earner(episode)

    async with rooms(place) as group:
        found = await asyncio.wait_for(played(group, tasks(4), agent, 4, Rules(first=2)), 60)
        assert group.pending == []
    for attempts in found:
        assert attempts.is_complete
        kinds = [attempt.outcome.kind for attempt in attempts]
        assert kinds == ["terminated", "cancelled"] * 2
        assert [attempt.reward is None for attempt in attempts] == [False, True] * 2


async def test_tasks_are_read_as_envs_become_free() -> None:
    """Not many more than can play, however long the caller takes."""
    read = 0

    async def endless() -> AsyncIterator[Any]:
        nonlocal read
        for seed in itertools.count():
            read += 1
            yield "", seed

    async with rooms(PLACES["loop"], num_workers=4) as group:
        async with contextlib.aclosing(play(group, endless(), earner, size=2)) as groups:
            async for _ in groups:
                await asyncio.sleep(0.2)
                break
            assert 1 <= read <= 8
        assert group.pending == []
    assert len(asyncio.all_tasks()) == 1


@pytest.mark.parametrize("place", [place for place in PLACES if place != "ray"])
async def test_an_iterator_that_is_left_open_logs_no_error(
    place: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Its group closes before it does, while agents play."""
    for _ in range(3):
        async with rooms(PLACES[place], num_workers=6) as group:
            async for _ in play(group, tasks(40), earner, size=2):
                break
    while left := asyncio.all_tasks() - {asyncio.current_task()}:
        await asyncio.wait(left)
    gc.collect()
    assert not [text for text in caplog.messages if "raised" in text or "retrieved" in text]


async def test_deaths_that_are_raised_are_failures_of_their_attempts() -> None:
    """The worker is replaced for the next attempt."""

    async def agent(episode: AttemptEpisode) -> None:
        await episode.step("die" if episode.spec.seed == 1 else "finish")

    async with rooms(PLACES["workers"], num_workers=1, on_worker_death="raise") as group:
        found = await played(group, tasks(3), agent, 1, Rules(retries=0))
    kinds = {attempts[0].spec.seed: attempts[0].outcome.kind for attempts in found}
    assert kinds[1] == "env_died"
    assert "env_died" not in (kinds[0], kinds[2])


async def test_tasks_of_other_entries_are_played_while_some_wait_for_a_client() -> None:
    """However many wait; all are played when it comes."""

    async def agent(episode: AttemptEpisode) -> str:
        await episode.step([0.0, 0.0])
        episode.finish()
        return episode.env_id

    local = {"name": "here", "task": lambda: CountingEnv(7), "placement": "inline"}
    order = [*["robots"] * 4, *["here"] * 3]
    specs = [EpisodeSpec("", k, entry=name) for k, name in enumerate(order)]
    found: list[str] = []
    async with rl.build_env_group([local, served(clients=["c0"])]) as group:
        handle: Any = group["robots-0"]
        async with asyncio.timeout(HANG):
            async for attempts in play(group, specs, agent, size=2):
                found += [str(attempt.result) for attempt in attempts]
                if found == ["here-0"] * 6:
                    client = ClientThread(handle.address, "c0", CountingEnv(0))
    assert found == ["here-0"] * 6 + ["robots-0/c0"] * 8
    client.join()


async def test_a_file_has_each_task_once(tmp_path: Path) -> None:
    """A second round of the same tasks would be taken for the first."""
    twice = [*tasks(2), *tasks(1)]
    async with rooms(PLACES["loop"], num_workers=1) as group:
        assert len(await played(group, twice, earner)) == 3
        with ResultsFile(tmp_path / "attempts.jsonl") as results:
            with pytest.raises(ValueError, match=r"seed=0.* is there twice: give it another seed"):
                await played(group, twice, earner, results=results)
            await played(group, tasks(2), earner, results=results)
            assert sorted(one.spec.seed for one in results) == [0, 1]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"size": 0}, "size must be at least 1"),
        ({"tasks": [EpisodeSpec("other", 0)]}, "no entry of this group can play"),
        ({"tasks": [7]}, "episodes should be EpisodeSpec"),
        ({"rules": {"retries": 1}}, r"rules should be Rules\(\.\.\.\)"),
        ({"results": "a.jsonl"}, r"should be an open ResultsFile\(path\)"),
    ],
)
async def test_bad_arguments(wrong: dict[str, Any], message: str) -> None:
    async with rooms(PLACES["loop"], num_workers=2) as group:
        arguments: dict[str, Any] = {"tasks": tasks(1), "agent": earner, **wrong}
        with pytest.raises((ValueError, TypeError), match=message):
            await played(group, **arguments)


@pytest.mark.parametrize(
    "wrong",
    [
        {"retries": -1},
        {"attempt_timeout": 0},
        {"first": 0},
        {"on_timeout": "retry"},
    ],
)
def test_bad_rules(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be"):
        Rules(**wrong)


def test_a_last_info_without_a_verdict_has_none() -> None:
    """The first info of the next episode has none about the last one."""
    both = {"success": False, "final_info": {"reward": 1.0}}
    assert success_of(both) is None
    masks = {"_final_info": np.array([True, False]), "_success": np.array([True, True])}
    assert success_of({**both, **masks, "success": np.array([False, True])}, 0) is None
    assert success_of({**both, **masks, "success": np.array([False, True])}, 1) == 1.0


@pytest.mark.parametrize("reward", [None, math.nan, math.inf])
async def test_no_reward_is_a_failure_of_the_env(place: dict[str, Any], reward: Any) -> None:
    """It was the advantage of nobody in its group; now it is tried again like any failure."""

    async def agent(episode: AttemptEpisode) -> None:
        await episode.step(1)
        if (episode.spec.seed, episode.index) not in tried:
            tried.add((episode.spec.seed, episode.index))
            with contextlib.suppress(rl.EnvRaised):
                await episode.step({"reward": reward})
        await earner(episode)

    tried = set[tuple[Any, int]]()
    async with rooms(place) as group:
        (attempts,) = await played(group, tasks(1), agent, size=2)
    assert attempts.rewards == [1.0] * 2
    for attempt in attempts:
        (failed,) = attempt.failures
        assert (failed.kind, failed.blame) == ("env_raised", "env")
        assert failed.cause.startswith("returned")


async def test_columns_and_actions_are_copied() -> None:
    """An agent may go on with the list that it has given away."""

    async def agent(episode: AttemptEpisode) -> None:
        tokens, ids, action = [0], np.zeros(2), {"reward": 1.0}
        while not episode.is_over:
            await episode.step(action, tokens=tokens, nested={"ids": [ids]})
            tokens.append(len(tokens))
            ids += 1
            action["reward"] += 1

    async with rooms(PLACES["loop"]) as group:
        ((attempt,),) = await played(group, tasks(1), agent)
    assert attempt.rewards == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert [one["reward"] for one in attempt.columns["action"]] == attempt.rewards
    assert attempt.columns["tokens"] == [[*range(k + 1)] for k in range(5)]
    assert [one["ids"][0][0] for one in attempt.columns["nested"]] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("reward", "steps"), [(None, 2), (7, 2), (-1.0, 5)])
async def test_an_agent_finishes(reward: float | None, steps: int) -> None:
    """With what it has earned, or with a reward of its own grading."""

    async def agent(episode: AttemptEpisode) -> None:
        for _ in range(steps):
            await episode.step(1)
        with pytest.raises(ValueError, match="finite number"):
            episode.finish(math.nan)
        episode.finish(reward)
        assert episode.is_over
        with pytest.raises(rl.RLightningError, match="has ended"):
            await episode.step(1)
        with pytest.raises(rl.RLightningError, match="has finished this attempt"):
            episode.finish(0.0)

    async with rooms(PLACES["loop"]) as group:
        ((attempt,),) = await played(group, tasks(1), agent)
    assert attempt.outcome.kind == ("terminated" if steps == 5 else "truncated")
    assert attempt.reward == (2.0 if reward is None else reward)


# -- what is lost ---------------------------------------------------------------------


class Sandbox:
    """Awaitable; a step raises if it is told so, or while its server is away."""

    is_away = False

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return "", {}

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0.001)
        if self.is_away or action == "fail":
            raise OSError("the sandbox is broken")
        return "", 1.0, True, False, {}


def sandboxes(num_workers: int) -> rl.EnvGroup:
    Sandbox.is_away = False
    return rl.build_env_group(Sandbox, name="box", num_workers=num_workers, placement="loop")


async def once(episode: AttemptEpisode) -> None:
    await episode.step("go")


async def test_a_broken_env_costs_no_group() -> None:
    """Whatever fails on it is tried on others, and it rests, though it is always free first."""

    async def agent(episode: AttemptEpisode) -> None:
        await episode.step("fail" if episode.env_id == "box-3" else "go")

    async with sandboxes(8) as group:
        found = await played(group, tasks(60), agent, 8)
    assert all(attempts.is_complete for attempts in found)
    failures = [one for attempts in found for attempt in attempts for one in attempt.failures]
    assert {one.env_id for one in failures} == {"box-3"}
    assert len(failures) <= 20  # Of 480; it rests for longer each time.
    assert max(len(attempt.failures) for attempts in found for attempt in attempts) == 1


async def test_an_env_that_raises_is_rebuilt(place: dict[str, Any]) -> None:
    """By default only `play` does that; steps of a batch leave it as it is."""

    async def agent(episode: AttemptEpisode) -> int:
        if len(marks) < 2:
            marks.append(await episode.call("mark", 7))
            await episode.step("raise")
        mark = await episode.call("mark")
        await earner(episode)
        return mark

    marks: list[int] = []
    async with rooms(place, 1) as group:
        ((attempt,),) = await played(group, tasks(1), agent)
        assert [one.kind for one in attempt.failures] == ["env_raised"] * 2
        assert (marks, attempt.result) == ([7, 7], 0)


@pytest.mark.usefixtures("moving")
@pytest.mark.parametrize(("deed", "kind"), [("raise", "env_raised"), ("die", "env_died")])
async def test_what_moves_something_real_is_reset_by_nobody_else_after_a_loss(
    deed: str, kind: str
) -> None:
    """The others go on without it; if nobody is left, the error says what to do."""

    async def agent(episode: AttemptEpisode) -> str:
        if episode.env_id not in broken:
            broken.append(episode.env_id)
            await episode.step(deed)
        await earner(episode)
        return episode.env_id

    broken = ["room-1", "room-2", "room-3"]
    asks = r"'room-\d'.*group\.reset\(env_ids=\['room-\d'\]\)"
    async with rooms(PLACES["workers"], on_worker_death="restart") as group:
        found = await played(group, tasks(12), agent)
        failed = [one for (attempt,) in found for one in attempt.failures]
        assert [(one.kind, one.env_id) for one in failed] == [(kind, "room-0")]
        assert {attempt.result for (attempt,) in found} <= {"room-1", "room-2", "room-3"}
        for rules, source in [(Rules(), tasks(12)), (Rules(retries=0), iter(tasks(12)))]:
            broken.clear()
            await group.reset()
            with pytest.raises(rl.RLightningError, match=asks):
                await played(group, source, agent, 1, rules)
            assert sorted(broken) == [f"room-{k}" for k in range(4)]


class Slow(Sandbox):
    """Counts its resets."""

    began = 0

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        type(self).began += 1
        return await super().reset(seed=seed, options=options)


async def test_free_envs_prepare_while_others_play() -> None:
    """As many as may play are reset before they are asked to; more are not."""
    playing = most = 0
    prepared = set[int]()

    async def agent(episode: AttemptEpisode) -> None:
        nonlocal playing, most
        playing += 1
        most = max(most, playing)
        while not prepared and Slow.began < 4:  # noqa: ASYNC110  # Two play, and two are ready.
            await asyncio.sleep(0)
        prepared.add(Slow.began)
        await once(episode)
        playing -= 1

    Slow.began = 0
    async with rl.build_env_group(Slow, name="box", num_workers=8, placement="loop") as group:
        rules = Rules(max_concurrency=2, attempt_timeout=HANG)
        found = await played(group, tasks(8), agent, 2, rules)
    assert most == 2
    assert min(prepared) == 4
    assert all(attempts.is_complete for attempts in found)


@pytest.mark.usefixtures("moving")
async def test_what_moves_something_real_is_not_reset_ahead() -> None:
    counts: list[int] = []

    async def agent(episode: AttemptEpisode) -> None:
        counts.append(Slow.began)
        await once(episode)

    Slow.began = 0
    async with rl.build_env_group(Slow, name="box", num_workers=4, placement="loop") as group:
        await played(group, tasks(6), agent, 1, Rules(max_concurrency=1))
    assert counts == [1, 2, 3, 4, 5, 6]


async def test_an_attempt_whose_turn_never_came_is_cancelled() -> None:
    async def agent(episode: AttemptEpisode) -> None:
        while Slow.began < 2 or not episode.spec.seed:  # noqa: ASYNC110  # The others wait.
            await asyncio.sleep(0)
        await once(episode)

    Slow.began = 0
    async with rl.build_env_group(Slow, name="box", num_workers=4, placement="loop") as group:
        specs = [EpisodeSpec("", 1)]
        rules = Rules(max_concurrency=1, first=1)
        (found,) = await played(group, specs, agent, 2, rules)
        assert [one.outcome.kind for one in found] == ["terminated", "cancelled"]
        assert group.pending == []
        assert len(await played(group, specs, once, 4)) == 1


class Poisoned(AwaitedRoom):
    """An action may end its worker, while all envs in that wait."""

    async def pause(self, action: Any = None) -> None:
        if action == "poison":
            asyncio.get_running_loop().call_later(0.02, os._exit, 3)
        await super().pause("hang" if action == "poison" else {"seconds": 0.01})


async def test_poison_tasks_cost_only_themselves() -> None:
    """Those that were executed with one are played again where nobody else plays."""
    poison = (3, 11, 12)

    async def agent(episode: AttemptEpisode) -> None:
        await episode.step(1)
        while not episode.is_over:
            await episode.step("poison" if episode.spec.seed in poison else 1)

    place = {"task": Poisoned, "envs_per_process": 4}
    async with rooms(place, 8) as group:
        found = await played(group, tasks(24), agent, size=2)
    assert sorted(one.spec.seed for one in found if not one.is_complete) == [*poison]
    for attempts in found:
        for attempt in attempts:
            outcomes = [*attempt.failures, attempt.outcome]
            unnamed = [one for one in outcomes if is_unnamed(one)]
            named = [one for one in outcomes if one.kind == "env_died" and one.blame == "env"]
            assert len(unnamed) <= 1
            assert bool(named) == (attempt.spec.seed in poison)


async def test_an_outage_does_not_burn_the_data_set(caplog: pytest.LogCaptureFixture) -> None:
    """While most envs fail, few attempts begin; it is said once, and then they go on."""
    async with sandboxes(8) as group:
        Sandbox.is_away = True
        asyncio.get_running_loop().call_later(1.2, setattr, Sandbox, "is_away", False)
        found = await played(group, tasks(100), once, 2)
    assert all(attempts.is_complete for attempts in found)
    tries = sum(len(attempt.failures) for attempts in found for attempt in attempts)
    assert tries <= 8 + 8
    said = [one.getMessage() for one in caplog.records]
    assert len([one for one in said if "most attempts fail" in one]) == 1
    assert len([one for one in said if "succeed again" in one]) == 1


def test_the_death_of_a_worker_is_no_outage() -> None:
    """Its envs were waiting together, or one of them is to blame and the others are not."""
    health, cause = Health(), "was killed by SIGKILL"
    for loss in (
        Loss(cause, "env_died", "infrastructure"),
        Loss(cause, "env_died", "env", "box-0"),
    ):
        for env_id in ("box-0", "box-1", "box-2", "box-3"):
            health.note(loss.outcome(env_id), 4, 10.0)
    assert not health.is_slow


async def test_it_is_said_once_if_all_resets_fail(caplog: pytest.LogCaptureFixture) -> None:
    """With their number and an env; then attempts begin one at a time."""
    async with rooms(PLACES["loop"]) as group:
        found = await played(group, tasks(5, deed="raise"), once, 1, Rules(retries=0))
    assert [attempts[0].outcome.kind for attempts in found] == ["not_started"] * 5
    # On a busy machine asyncio's debug mode warns of slow callbacks.
    (said,) = [one.getMessage() for one in caplog.records if one.name != "asyncio"]
    assert "most attempts fail (3 not_started, such as on env 'room-" in said


async def test_what_fails_when_an_outage_begins_costs_no_try(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The service fails all that play at once, then each of them once more, and comes back."""

    async def agent(episode: AttemptEpisode) -> None:
        if (episode.spec.seed or 0) >= 8:
            if next(arrived) == 8:
                Sandbox.is_away = True
                all_play.set()
            await all_play.wait()
        await once(episode)

    def note_begin(self: Health, now: float) -> None:
        del self, now
        begun.append(None)
        Sandbox.is_away = len(begun) <= 8

    arrived, all_play, begun = itertools.count(1), asyncio.Event(), list[None]()
    monkeypatch.setattr(Health, "note_begin", note_begin)
    async with sandboxes(8) as group:
        found = await played(group, tasks(16), agent, 1, Rules(retries=1))
    failures = {attempts.spec.seed: len(attempts[0].failures) for attempts in found}
    assert all(attempts.is_complete for attempts in found)
    assert {seed: failures[seed] >= 2 for seed in range(16)} == {k: k >= 8 for k in range(16)}


async def test_the_end_of_a_pause_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It comes between two looks at a clock, which has moved on at each."""

    async def agent(episode: AttemptEpisode) -> None:
        if next(tries) < 3:
            raise ConnectionError("the model is away")
        await once(episode)

    tries, looks, now = itertools.count(), itertools.count(), time.monotonic()
    clock = SimpleNamespace(monotonic=lambda: now + next(looks) / 4)
    monkeypatch.setattr("rlightning_aio.attempts.playing.time", clock)
    async with sandboxes(1) as group, asyncio.timeout(HANG):
        found = await played(group, tasks(4), agent, 1, Rules(retries=3))
    assert all(attempts.is_complete for attempts in found)


async def test_an_attempt_that_goes_well_ends_the_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long the pause would be: others begin when there is something to begin."""

    async def agent(episode: AttemptEpisode) -> None:
        number = episode.spec.seed or 0
        if number < 4:
            raise ConnectionError("the model is away")
        await once(episode)
        if number == 4:
            goes_well.set()
            await has_begun.wait()
        has_begun.set()

    async def stream() -> AsyncIterator[EpisodeSpec]:
        for spec in tasks(5):
            yield spec
        await goes_well.wait()
        yield EpisodeSpec("", 5)

    goes_well, has_begun = asyncio.Event(), asyncio.Event()
    monkeypatch.setattr(Health, "note_begin", lambda self, now: setattr(self, "_next", now + 1e6))
    async with sandboxes(2) as group, asyncio.timeout(HANG):
        found = await played(group, stream(), agent, 1, Rules(retries=0))
    kinds = Counter(attempt.outcome.kind for (attempt,) in found)
    assert kinds == {"agent_raised": 4, "terminated": 2}


async def test_too_many_failures_end_the_run() -> None:
    async def agent(episode: AttemptEpisode) -> None:
        if (episode.spec.seed or 0) % 2:
            episode.finish()

    async with sandboxes(2) as group:
        with pytest.raises(rl.RLightningError, match=r"21 of the last .*: 21 agent_stopped; .*box"):
            await played(group, tasks(300), agent, 1, Rules(max_failures=0.2))


async def test_a_bug_in_the_agent_ends_the_run(tmp_path: Path) -> None:
    """The first group shows it. A resume plays again what the policy has not made fail."""
    is_right = False

    async def agent(episode: AttemptEpisode) -> None:
        if episode.index == 0:
            raise rl.EnvError("no such tool", blame="policy")
        if not is_right:
            raise NameError("a typo")
        await once(episode)

    path = tmp_path / "attempts.jsonl"
    is_typo = pytest.raises(rl.RLightningError, match=r"all 2 attempts.*typo")
    async with sandboxes(2) as group:
        with ResultsFile(path) as results, is_typo:
            await played(group, tasks(40), mistaken, 2, results=results)
        is_right = True
        with ResultsFile(path) as results:
            found = await played(group, tasks(40), agent, 2, results=results)
    assert len(found) == 40
    assert [attempt.outcome.kind for attempt in found[0]] == ["agent_raised", "terminated"]


async def test_a_model_that_is_away_at_first_is_no_bug_in_the_agent() -> None:
    """Whatever the first group comes to, the others are played."""

    async def agent(episode: AttemptEpisode) -> None:
        if episode.spec.seed == 0:
            raise ConnectionError("the model is away")
        await once(episode)

    async with sandboxes(1) as group:
        found = await played(group, tasks(2), agent, 1, Rules(retries=0))
    (first,), (second,) = found
    assert (first.outcome.kind, first.outcome.blame) == ("agent_raised", "infrastructure")
    assert second.outcome.kind == "terminated"


async def mistaken(episode: AttemptEpisode) -> None:
    raise NameError("a typo")


async def test_what_was_not_handed_out_comes_first_after_a_resume(tmp_path: Path) -> None:
    """Before tasks that come earlier in the list."""
    path, stands_still = tmp_path / "attempts.jsonl", {0, 1}

    async def agent(episode: AttemptEpisode) -> None:
        if episode.spec.seed in stands_still:
            await asyncio.Event().wait()
        await once(episode)

    async with sandboxes(4) as group:
        with ResultsFile(path) as results:
            async with contextlib.aclosing(play(group, tasks(4), agent, results=results)) as groups:
                (first,) = await anext(groups)
                while len(results) < 2:  # noqa: ASYNC110  # It tells nobody.
                    await asyncio.sleep(0)
    stands_still.clear()
    async with sandboxes(1) as group:
        with ResultsFile(path) as results:
            (second,), *others = await played(group, tasks(4), agent, results=results)
    assert {first.spec.seed, second.spec.seed} == {2, 3}
    assert sorted(attempts.spec.seed or 0 for attempts in others) == [0, 1]


async def test_lines_are_written_beside_the_event_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attempts go on while the disk is slow; no group comes before it is in the file, and who waits
    for that and is cancelled costs no line.
    """
    disk, begins, to_json = threading.Event(), threading.Event(), Attempt.to_json
    ended, most_have_ended = Counter[int](), asyncio.Event()

    def slow(attempt: Attempt) -> dict[str, Any]:
        begins.set()
        assert disk.wait(HANG)
        return to_json(attempt)

    async def agent(episode: AttemptEpisode) -> None:
        await earner(episode)
        ended[episode.spec.seed] += 1
        if ended.total() == 4:
            most_have_ended.set()

    monkeypatch.setattr(Attempt, "to_json", slow)
    async with rooms(PLACES["loop"]) as group:
        with ResultsFile(tmp_path / "results") as results:
            playing = asyncio.ensure_future(played(group, tasks(6), agent, 2, results=results))
            await most_have_ended.wait()
            assert await asyncio.to_thread(begins.wait, HANG)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(results.written(), 0.05)
            assert not playing.done()
            disk.set()
            assert len(await playing) == 6
            assert len(results) == 12


async def test_a_file_keeps_no_columns_in_memory(tmp_path: Path) -> None:
    """They are read again when they are asked for."""

    async def agent(episode: AttemptEpisode) -> None:
        await episode.step("go", tokens=[*range(20_000)])

    async with sandboxes(4) as group:
        with ResultsFile(tmp_path / "attempts.jsonl") as results:
            tracemalloc.start()
            async for _ in play(group, tasks(12), agent, results=results):
                pass
            results.flush()
            gc.collect()  # What waits to be collected is held by nobody.
            held, _ = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert held < 3_000_000  # The ids of one attempt take 720,000 bytes.
            assert [one.columns["tokens"][0][-1] for one in results] == [19_999] * 12


async def test_a_group_is_played_once_at_a_time() -> None:
    async with sandboxes(2) as group:
        async with contextlib.aclosing(play(group, tasks(9), once)) as groups:
            await anext(groups)
            with pytest.raises(EnvBusy, match="another play"):
                await played(group, tasks(1), once)
        assert len(await played(group, tasks(3), once)) == 3


# -- whose time it is -----------------------------------------------------------------


async def test_time_in_which_the_trainer_blocks_the_loop_is_not_the_attempts() -> None:
    async def agent(episode: AttemptEpisode) -> None:
        for _ in range(5):
            await asyncio.sleep(0.01)
            await episode.step(1)

    async with rooms(PLACES["loop"]) as group:
        found: list[AttemptGroup] = []
        async for attempts in play(group, tasks(6), agent, 2, Rules(attempt_timeout=1.0)):
            time.sleep(1.2)  # noqa: ASYNC251  # The update of the weights.
            found.append(attempts)
    assert all(attempts.is_complete for attempts in found)


async def test_the_metrics_say_who_waits_for_whom() -> None:
    def numbers() -> dict[str, float]:
        found = group.metrics()
        return {name[9:]: found[name] for name in found if name.startswith("attempts/")}

    async def agent(episode: AttemptEpisode) -> None:
        await asyncio.sleep(0.02)
        if (episode.spec.seed, episode.index) == (0, 0) and (0, 0) not in tried:
            tried.add((0, 0))
            await episode.step("raise")
        if episode.spec.seed == 1:
            raise ValueError
        await earner(episode)

    tried = set[tuple[int, int]]()
    async with rooms(PLACES["loop"], num_workers=2) as group:
        assert numbers() == {}
        for _ in range(2):
            tried.clear()
            playing = play(group, tasks(4), agent, 2, Rules(retries=1, max_concurrency=1))
            async for _ in playing:
                time.sleep(0.1)  # noqa: ASYNC251  # The update of the weights.
                now = numbers()
                assert 0 <= now["playing"] + now["waiting"] <= 4
        found = numbers()
        assert group.get_env_stats()["room-0"]["outcomes_env_raised"] in (0, 1, 2)
    assert (found["playing"], found["waiting"], found["groups_waiting"]) == (0, 0, 0)
    assert (found["outcomes_terminated"], found["outcomes_agent_raised"]) == (12, 4)
    assert found["retries"] == 2
    assert found["seconds_in_agents"] > 0.02 * 16
    assert found["seconds_blocked"] > 0.1
    assert found["outcomes_timed_out"] == 0


async def test_time_in_the_queue_of_the_entry_is_not_the_attempts() -> None:
    """Each step takes a twentieth of the limit, and eight wait for the one that is executed."""

    async def agent(episode: AttemptEpisode) -> None:
        for _ in range(5):
            await episode.step({"reward": 1.0, "seconds": 0.1})

    async with rooms(PLACES["loop"], 8, max_concurrency=1) as group:
        (attempts,) = await played(group, tasks(1), agent, 8, Rules(attempt_timeout=2.0))
    assert [attempt.outcome.kind for attempt in attempts] == ["terminated"] * 8


async def test_what_is_not_asynchronous_is_refused() -> None:
    def agent(episode: AttemptEpisode) -> int:
        return 7

    wrong: Any = agent
    refused = pytest.raises(TypeError, match=r"needs an asynchronous group.*not EnvGroup of .*sync")
    with sync.build_env_group("CartPole-v1", placement="inline") as group, refused:
        await played(group, tasks(1), earner)
    async with rooms(PLACES["loop"]) as group:
        with pytest.raises(TypeError, match="returned 7; it must be a coroutine function"):
            await played(group, tasks(1), wrong)
