"""Programs of `play`: agents that raise, hang, stop early or go on, and iterators that are left.

Each agent notes what it did and how it ended. From that follows what its attempt must say; the
rewards of the attempt must be those of a script that does the same alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import tempfile
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final
from unittest.mock import patch

import numpy as np
from simulator.model import Violation, require
from simulator.scripted import Script, words_of
from simulator.session import action_of
from simulator.training import InContext
from simulator.world import Faults

from rlightning_aio.attempts import EpisodeSpec, ResultsFile, Rules, file, play
from rlightning_aio.attempts.queue import AttemptQueue
from rlightning_aio.attempts.rules import is_retried
from rlightning_aio.errors import BadAction, EnvFault, RLightningError
from rlightning_aio.outcomes import BLAMES, is_bystanders

if TYPE_CHECKING:
    from collections.abc import Callable

    from simulator.model import Env
    from simulator.scripted import Act

    from rlightning_aio.attempts import Attempt, AttemptEpisode, AttemptGroup
    from rlightning_aio.attempts.queue import Job

_LOST: Final = ("env_died", "env_hung", "env_raised", "env_away", "not_started")
_SIZED: Final = ("vector", "single", "digits", "number")


class AgentFailed(Exception):
    """As an agent may."""

    def __init__(self, blame: str) -> None:
        super().__init__(f"an agent that fails by {blame}")
        self.blame = blame


_ENDS = {"stopped": "agent_stopped", "finished": "truncated"}
"""The kinds of outcomes, by the ends of agents that end before their envs do."""


@dataclass
class Played:
    """What an agent did.

    Attributes:
        episode: what it got.
        acts: of the steps that returned a result.
        end: ``over``, ``stopped`` or ``cancelled``, or the kind of its failure.
    """

    episode: AttemptEpisode
    acts: list[Act] = field(default_factory=list)
    end: str = ""


class _AtOnce(Executor):
    """Writes without a thread, which no world has."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        done = Future[Any]()
        done.set_result(fn(*args, **kwargs))
        return done


class Attempts(InContext):
    """A run of a program that plays groups of attempts."""

    def drawn_limit(self, rng: Random) -> float | None:
        return rng.choice([None, None, math.inf, 3, 5])

    # -- agents

    async def agent(self, episode: AttemptEpisode) -> Any:
        """Play an attempt, and note how it ended."""
        played = Played(episode)
        tries = self.played.setdefault((episode.spec.key, episode.index), [])
        number = f"{self.op_seed} {episode.spec.seed} {episode.index} {len(tries)}"
        tries.append(played)
        try:
            swallows = await self._play(Random(number), played)
        except EnvFault as fault:
            played.end = fault.outcome.kind
            raise
        except (AgentFailed, BadAction):
            played.end = "agent_raised"
            raise
        except asyncio.CancelledError:
            played.end = "cancelled"
            if Random(number).random() < 0.2:
                self.stubborn.add(asyncio.current_task())
                await self._go_on(episode)
            raise
        ends = Random(number).random() < 0.5 and not episode.is_over
        if ends and not swallows:
            episode.finish()
        played.end = swallows or ("finished" if ends else "over" if episode.is_over else "stopped")
        if played.end == "over":
            with self.expected(RLightningError, "a step after the end"):
                await episode.step(None)
        return number

    async def _go_on(self, episode: AttemptEpisode) -> None:
        """Ignore a cancellation."""
        await asyncio.sleep(5)
        with self.expected(RLightningError, "a step after the end"):
            await episode.step(None)

    async def _play(self, rng: Random, played: Played) -> str:
        """Step until the end, or fail; return the kind of a failure that is not raised."""
        episode = played.episode
        env = self.by_id[episode.env_id]
        while not episode.is_over:
            if not self.plain:
                await self._dawdle(rng, env, episode)
                if rng.random() < 0.1:
                    return ""
                if "calls" in self.features and env.client is None and rng.random() < 0.2:
                    self._check_value(played, await episode.call("peek", 7))
            elif len(played.acts) >= 4:
                return ""
            (act,) = self.acts(rng, env, plain=self.plain)
            if env.client is not None:
                env.client.asked.append(act)
            env.hangs += env.entry.form == "awaitable" and act[0].startswith("hang")
            columns = {"tokens": [len(played.acts)]} if "extras" in self.features else {}
            try:
                await episode.step(action_of(env, [act]), **columns)
            except EnvFault as fault:
                if rng.random() < 0.3:
                    with self.expected(RLightningError, "a step after one that has failed"):
                        await episode.step(None)
                    return fault.outcome.kind
                raise
            played.acts.append(act)
        return ""

    async def _dawdle(self, rng: Random, env: Env, episode: AttemptEpisode) -> None:
        """Do what agents do between two steps."""
        if rng.random() < 0.3:
            await asyncio.sleep(10 ** rng.uniform(-5, 0))
        if "raise" in self.features and rng.random() < 0.05:
            raise AgentFailed(rng.choice(["infrastructure", "env", "policy", "caller"]))
        if "misuse" in self.features and env.entry.controls in _SIZED and rng.random() < 0.05:
            self.counts["BadAction"] += 1
            await episode.step(np.zeros((3, 3, 7)))
        if self.may_hang and rng.random() < 0.05:
            await asyncio.Event().wait()

    def _check_value(self, played: Played, value: Any) -> None:
        words, _ = value
        right = tuple(self._script(played).words)
        found = tuple(words[0])
        require(_without_episode(found) == _without_episode(right), "another state", found, right)

    # -- operations

    plain = False

    async def op_attempts(self, rng: Random) -> None:
        self.op_seed, self.played, self.stubborn = rng.getrandbits(32), {}, set()
        self.is_bug, self.excused = False, dict[Any, int]()
        specs = self.specs(rng, 6)
        size, rules = rng.randint(1, 4), self._rules(rng)
        leave = self._leave(rng, len(specs))
        leaves = leave != (None, None)
        may_time_out = rules.attempt_timeout is not None
        self.may_hang = may_time_out or leave[0] is not None
        excuse = patch.object(AttemptQueue, "excuse", self._excusing(AttemptQueue.excuse))
        with tempfile.TemporaryDirectory() as folder, excuse:
            path = Path(folder) / "attempts" if rng.random() < 0.3 else None
            self.has_file = path is not None
            tasks = partial(_loaded, specs) if rng.random() < 0.3 else specs.copy
            playing = partial(self._played, tasks, size, rules, path)
            found = await playing(*leave)
            if path is not None:
                self.may_hang = may_time_out
                await playing(None, None)
                self._check_file(path, specs, size, rules)
        if not (leaves or self.is_bug):
            keys = sorted(one.spec.key for one in found)
            require(keys == sorted(spec.key for spec in specs), "other groups", keys)
        if self.stubborn:
            await asyncio.wait(self.stubborn)

    def _excusing(self, excuse: Callable[..., None]) -> Callable[..., None]:
        """Note which failures don't count, because most attempts fail."""

        def noted(queue: AttemptQueue, playing: list[Job]) -> None:
            excuse(queue, playing)
            self.counts["outages"] += 1
            jobs = [*playing, *chain.from_iterable(queue.queues())]
            self.excused |= {(job.spec.key, job.index): job.num_excused for job in jobs}

        return noted

    def _rules(self, rng: Random) -> Rules:
        times = "timeouts" in self.features and rng.random() < 0.6
        return Rules(
            attempt_timeout=10 ** rng.uniform(-3, 1) if times and not self.plain else None,
            on_timeout=rng.choice(["fail", "end"]),
            retries=rng.randint(0, 3),
            first=rng.randint(1, 4) if rng.random() < 0.25 else None,
            max_concurrency=rng.choice([None, None, 1, 2]),
        )

    def _leave(self, rng: Random, count: int) -> tuple[float | None, int | None]:
        """Seconds after which the iterator is cancelled, or groups after which it is closed."""
        if self.plain or "cancel" not in self.features or rng.random() < 0.5:
            return None, None
        if rng.random() < 0.3:
            return None, rng.randint(1, count)
        return 10 ** rng.uniform(-6, 1), None

    async def _played(
        self,
        tasks: Callable[[], Any],
        size: int,
        rules: Rules,
        path: Path | None,
        seconds: float | None,
        most: int | None,
    ) -> list[AttemptGroup]:
        """Play to the end, or leave the iterator; check what it leaves behind."""
        found: list[AttemptGroup] = []

        async def taken() -> None:
            with results_file(path) if path else contextlib.nullcontext() as results:
                groups = play(self.group, tasks(), self.agent, size, rules, results)
                async with contextlib.aclosing(groups):
                    async for attempts in groups:
                        self._check_group(attempts, size, rules)
                        found.append(attempts)
                        if len(found) == most:
                            return

        taking = asyncio.create_task(taken())
        await asyncio.wait({taking}, timeout=seconds)
        if not taking.done():
            taking.cancel()
            await self._in_time(taking)
        try:
            await taking
        except asyncio.CancelledError:
            require(seconds is not None, "cancelled by nobody")
            self.counts["attempts cancelled"] += 1
        except RLightningError as error:
            self.count(error)
            self._end(error)
        left = [one for one in self.group.pending if self.by_id[one].client is None]
        require(not left, "pending after all attempts", left)
        ends = [one.end for tries in self.played.values() for one in tries]
        require(all(ends), "an agent plays on", ends)
        return found

    async def _in_time(self, taking: asyncio.Task[None]) -> None:
        """All envs are free within a second of a cancellation, unless the world is slow."""
        faults, slow = self.program.faults, "slow" in self.features
        is_calm = faults == Faults(deaths=faults.deaths) and not (slow or self.clients)
        _, late = await asyncio.wait({taking}, timeout=1.0 if is_calm else self.hang)
        require(not late, "the envs are not free in time")

    def _end(self, error: RLightningError) -> None:
        """Check that no env is left that could play something, or all agents have raised."""
        if "the agent has failed in all" in str(error):
            require("raise" in self.features or "misuse" in self.features, "no agent has raised")
            self.is_bug = True
            return
        raise Violation(f"ended, and envs are there: {error!r}") from error

    # -- what came of them

    def _check_group(self, attempts: AttemptGroup, size: int, rules: Rules) -> None:
        indices = [one.index for one in attempts]
        require(indices == [*range(size)], "other attempts", indices)
        whole = len(attempts.rewards)
        needed = min(size, rules.first or size)
        require(attempts.is_complete == (whole >= needed), "complete, or not", attempts)
        require(rules.first is None or whole <= needed, "more than the first", attempts)
        self.counts["groups of attempts"] += 1
        self.counts["complete groups"] += attempts.is_complete
        for attempt in attempts:
            self.counts["attempts"] += 1
            self.counts[f"attempts {attempt.outcome.kind}"] += 1
            self.counts["attempts tried again"] += bool(attempt.failures)
            try:
                self._check(attempt, rules, is_full=whole >= needed)
            except Violation as violation:
                raise Violation(f"{violation}\n  {attempt}") from None

    def _check(self, attempt: Attempt, rules: Rules, *, is_full: bool) -> None:
        """An attempt ends as its agent and its env did, or says why it has not."""
        outcome = attempt.outcome
        outcomes = [*attempt.failures, outcome]
        numbers = [one.attempt for one in outcomes]
        require(numbers == [*range(len(outcomes))], "tries that are not counted", numbers)
        for one in outcomes:
            require(bool(one.cause) and one.blame in BLAMES, "without a cause", one)
        require(all(map(is_retried, attempt.failures)), "tried again, and it should not be")
        excused = self.excused.get((attempt.spec.key, attempt.index), 0)
        counted = sum(not is_bystanders(one) for one in attempt.failures[excused:])
        require(counted <= rules.retries, "tried too often", counted)
        if self.has_file and excused:  # Perhaps in the run before, which this one doesn't know.
            excused, counted = 0, sum(not is_bystanders(one) for one in attempt.failures)
        is_excused = is_bystanders(outcome) or outcome.attempt < excused
        may_go_on = is_excused or counted < rules.retries
        require(not (is_retried(outcome) and may_go_on), "not tried again")
        if outcome.kind == "cancelled":
            require(rules.first is not None and is_full, "cancelled, and no surplus")
        require(min(outcome.seconds) >= 0, "less than no time")
        require((attempt.reward is None) == outcome.is_failure, "a failure with a reward")
        require(outcome.is_failure <= (attempt.success is None), "a failure that succeeds")
        tries = self.played.get((attempt.spec.key, attempt.index), [])
        own = [one for one in tries if one.episode.columns is attempt.columns]
        if own:
            self._compare(attempt, own[0], rules)
        elif not self.has_file:
            kinds = (*_LOST, "timed_out", "cancelled")
            require(outcome.kind in kinds, "it has not failed, and nobody has played it")
            require(not attempt.length, "nobody has played it, and it has a length")

    def _compare(self, attempt: Attempt, played: Played, rules: Rules) -> None:
        """Check an attempt against what its agent did, and what a script alone does."""
        outcome, env = attempt.outcome, self.by_id[attempt.env_id]
        require(env.entry.name == attempt.spec.entry, "an env of another entry")
        script = self._script(played, steps=0)
        self._check_shown(env, attempt.first, script)
        rewards: list[float] = []
        ended = cut = False
        info: dict[str, Any] = {}
        for act in played.acts:
            reward, ended, cut, info = script.step(*act)
            rewards.append(reward)
        require(attempt.rewards == rewards, "other rewards", rewards)
        require(attempt.length == len(rewards), "another length", len(rewards))
        sizes = {len(column) for column in attempt.columns.values()}
        require(sizes <= {len(rewards)}, "columns of another length", sizes)
        cut |= len(rewards) >= (self.limit or math.inf)
        # An agent may end by itself in the moment in which its time is over or it is a surplus.
        cut_short = ["cancelled"] * (rules.first is not None or played.end == "cancelled")
        if rules.attempt_timeout is not None and rules.on_timeout == "end":
            # Its first step may be over in the moment in which its time is.
            cut_short += ["truncated"] * (attempt.length > 0) + ["timed_out"] * (attempt.length < 2)
            cut_short += ["env_hung"]
        elif rules.attempt_timeout is not None:
            cut_short += ["timed_out"]
        if played.end == "over":
            kind = "terminated" if ended else "truncated"
            require(ended or cut, "over, and nothing has ended it")
            require(outcome.kind in (kind, *cut_short), "another end", kind)
        elif played.end in _ENDS:
            own = [_ENDS[played.end], *cut_short]
            require(outcome.kind in own, "another end", own)
        elif played.end == "cancelled":
            own = [*cut_short, *self._late_ends(played)]
            require(outcome.kind in own, "another end", own)
        elif played.end == "agent_raised":
            require(outcome.kind in (played.end, *cut_short), "another failure", played.end)
        else:
            require(outcome.kind == played.end, "another failure", played.end)
        if outcome.kind not in _LOST and "zero_copy" not in self.features:
            self._check_shown(env, attempt.last, script)
        if not outcome.is_failure:
            require(attempt.reward == sum(rewards), "another reward", sum(rewards))
            success = info["success"] > 0.5 if "success" in info else None
            require(attempt.success == success, "another success", success)

    def _late_ends(self, played: Played) -> list[str]:
        """The end of an agent that goes on, and steps before a late trainer gives it up."""
        fault = played.episode.fault
        return [fault.kind] if self.program.faults.lags and fault is not None else []

    def _script(self, played: Played, steps: int | None = None) -> Script:
        """The script of an env, where some steps of an attempt lead to."""
        env, spec = self.by_id[played.episode.env_id], played.episode.spec
        script = Script(env.codes[0], env.entry.own_limit)
        script.reset(spec.seed, None if spec.options is None else {**spec.options})
        for act in played.acts[:steps]:
            script.step(*act)
        return script

    def _check_shown(self, env: Env, observation: Any, script: Script) -> None:
        shown = words_of(env.entry.layout, observation)
        own = _without_episode(shown), _without_episode(script.words)
        require(own[0] == own[1], "another observation", shown, script.words)

    def _check_file(self, path: Path, specs: list[EpisodeSpec], size: int, rules: Rules) -> None:
        """A file has each attempt once, and none is missing."""
        with results_file(path) as results:
            places = [(one.spec.key, one.index) for one in results]
            whole = [one.spec.key for one in results if not one.outcome.is_failure]
        require(len({*places}) == len(places), "an attempt is twice in the file", places)
        if self.is_bug:
            return
        for spec in specs:
            count = sum(key == spec.key for key, _ in places)
            enough = rules.first is not None and whole.count(spec.key) >= rules.first
            require(count == size or enough, "an attempt is missing in the file", spec, count)

    async def finish(self) -> None:
        self.plain = True
        await self.op_attempts(Random(1))
        await super().finish()


def results_file(path: Path) -> ResultsFile:
    with patch.object(file, "new_writer", _AtOnce):
        return ResultsFile(path)


async def _loaded(specs: list[EpisodeSpec]) -> Any:
    for spec in specs:
        await asyncio.sleep(0.01)
        yield spec


def _without_episode(words: Any) -> tuple[int, ...]:
    """How many episodes an env has played before is not part of an episode."""
    code, seed, _, step, mix = words
    return code, seed, step, mix
