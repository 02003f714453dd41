"""`play`: groups of attempts at tasks, by agents that are coroutines.

Rule: an engine of its own task keeps the envs busy, however long its caller takes for a group of
attempts; no more tasks are begun while as many attempts wait for the caller as may play at once.
Every try of an attempt is a task. It ends within a second of its cancellation, whatever the agent
does, and its env is idle or replaced then.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections import Counter, deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, cast, get_args
from weakref import WeakSet

from rlightning_aio._core.group.api.facade import (
    is_resettable,
    numbers_of_attempts,
    stop_hardware,
)
from rlightning_aio.attempts.clock import Clock
from rlightning_aio.attempts.episode import AttemptInPlay
from rlightning_aio.attempts.file import ResultsFile
from rlightning_aio.attempts.health import Health
from rlightning_aio.attempts.players import Players
from rlightning_aio.attempts.queue import LOOK_SECONDS, AttemptQueue
from rlightning_aio.attempts.records import Attempt, AttemptGroup
from rlightning_aio.attempts.rules import Rules, needed
from rlightning_aio.attempts.tasks import TaskSource, spec_of_task
from rlightning_aio.attempts.tries import Try, surely
from rlightning_aio.errors import EnvBusy, RLightningError
from rlightning_aio.outcomes import Outcome, OutcomeKind

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterable, Iterable

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts.queue import Job, TaskInPlay
    from rlightning_aio.attempts.tries import Agent

_BURST: Final = 16
"""Most attempts that begin in one turn of the event loop, so that it is free for others."""
_MOST_LACKING: Final = 1000
"""Most attempts that wait for entries without an env while tasks are read for the others."""
_LAST: Final = 100
"""Attempts among which failures are counted."""
_NUMBERS: Final = (
    *("playing", "waiting", "groups_waiting", "lag", "seconds_blocked"),
    *("seconds_in_agents", "retries", *(f"outcomes_{kind}" for kind in get_args(OutcomeKind))),
)
_in_play: Final[WeakSet[EnvGroup]] = WeakSet()
_SURPLUS: Final = "enough other attempts at its task have ended"


async def play(
    group: EnvGroup,
    tasks: Iterable[Any] | AsyncIterable[Any],
    agent: Agent,
    size: int = 1,
    rules: Rules | None = None,
    results: ResultsFile | None = None,
) -> AsyncGenerator[AttemptGroup]:
    """Have an agent attempt each task several times; yield the attempts at a task when it is done.

    ::

        async def agent(episode):
            while not episode.is_over:
                reply = await model(episode.last.observation)
                await episode.step(reply.message, tokens=reply.token_ids)

        async for attempts in play(group, tasks, agent, size=8):
            rewards = attempts.rewards

    Args:
        group: initialised, with nothing `pending`; of any placement.
            Each env plays one attempt at a time, also one with sub-environments.
        tasks: `EpisodeSpec`, or tuples (task, seed) or (task, seed, options); an iterable or an
            async iterable, read only as envs become free.
        agent: a coroutine function, which gets an `AttemptEpisode`.
        size: number of attempts at each task.
        rules: see `Rules`.
        results: a file to add attempts to, and to continue from; it has no observations.

    Groups come in the order of their ends; of a list of tasks, those in `results` first. When the
    iterator ends, is closed (`contextlib.aclosing`) or cancelled, every env is idle or replaced.

    Raises:
        TypeError: the group is synchronous, or an argument has another type.
        EnvBusy: an env has a request in flight or a result to be collected, or plays already.
        ValueError: `size` is below 1, or no entry can play a task, or more than one can, or there
            is a file, and a task is twice there.
        RLightningError: too many attempts have failed: all at the first task, or by `rules`; or
            only envs are left that move something real and have failed: only you reset them.
    """
    _check(group, rules, results, size)
    rules = rules or Rules()
    source = TaskSource(_left_first(tasks, group, needed(rules, size), results))
    engine = _Engine(group, source, agent, size, rules, results)
    running = _started(engine, group)
    try:
        while True:
            while engine.done:
                yield await engine.take()
            if running.done():
                running.result()  # Raises its error, if it has one.
                return
            await engine.news.wait()
            engine.news.clear()
    finally:
        running.cancel()
        await asyncio.wait({running})  # Cancelled once more, it ends all the same.
        _ = running.cancelled() or running.exception()


def _started(engine: _Engine, group: EnvGroup) -> asyncio.Task[None]:
    running = asyncio.create_task(engine.run())
    _in_play.add(group)
    running.add_done_callback(lambda _: _in_play.discard(group))
    return running


def _left_first(tasks: Any, group: EnvGroup, whole: int, results: ResultsFile | None) -> Any:
    """Put those of a list first that have a `whole` group in a file, not handed out yet."""
    if results is None or not isinstance(tasks, Sequence):
        return tasks
    assigned, left = Players(group).assigned, results.left()
    specs = [assigned(spec_of_task(task)) for task in cast("Sequence[Any]", tasks)]
    return sorted(specs, key=lambda spec: left[spec.key] < whole)


def _check(group: Any, rules: Any, results: Any, size: int) -> None:
    if not hasattr(group, "episode"):
        raise TypeError(
            f"play() needs an asynchronous group, as rlightning_aio.build_env_group makes it, not "
            f"{type(group).__name__} of {type(group).__module__}"
        )
    if not isinstance(rules, Rules | None):
        raise TypeError(f"rules should be Rules(...), not {rules!r}")
    if not isinstance(results, ResultsFile | None):
        raise TypeError(f"results should be an open ResultsFile(path), not {results!r}")
    if size < 1:
        raise ValueError(f"size must be at least 1, not {size!r}")
    if group in _in_play:
        raise EnvBusy("another play() plays on this group: end it before, or build a second group")
    if busy := group.pending:
        raise EnvBusy(f"{busy[0]!r} has a request whose result was not collected; collect it")


def _is_bug(outcome: Outcome) -> bool:
    return outcome.kind == "agent_raised" and outcome.blame == "caller"


class _Numbers:
    """What `metrics` of a group has of the attempts of `play`, as sums over all its calls.

    docs/metrics.md explains every number.
    """

    def __init__(self, group: Any) -> None:
        self._numbers = numbers_of_attempts(group)
        for name in _NUMBERS:
            self._numbers.setdefault(f"attempts/{name}", 0)
        self._blocked = 0.0

    def note(self, clock: Clock, **now: int) -> None:
        """Note how many attempts and groups there are now, and for how long nothing could run."""
        self._numbers.update({f"attempts/{name}": number for name, number in now.items()})
        self._numbers["attempts/lag"] = clock.lag
        self._add("seconds_blocked", clock.blocked - self._blocked)
        self._blocked = clock.blocked

    def note_end(self, outcome: Outcome, *, is_retried: bool) -> None:
        """Note the end of a try."""
        self._add("seconds_in_agents", outcome.seconds.agent)
        self._add("retries" if is_retried else f"outcomes_{outcome.kind}", 1)

    def _add(self, name: str, number: float) -> None:
        self._numbers[f"attempts/{name}"] += number


class _Engine:
    """The attempts in progress.

    Attributes:
        done: groups that the caller has not taken.
        news: is set when there is one, or nothing more will come.
    """

    def __init__(
        self,
        group: EnvGroup,
        source: TaskSource,
        agent: Agent,
        size: int,
        rules: Rules,
        results: ResultsFile | None,
    ) -> None:
        self._group, self._source, self._agent = group, source, agent
        self._size, self._rules = size, rules
        self._results = results
        self._queue = AttemptQueue(group, rules, results)
        self._has_clients = len(group) > group.size()
        # What moves something real, as a client may, doesn't move before its agent's turn.
        is_plain = all(is_resettable(group, env_id) for env_id in group.env_ids)
        self._ahead = 2 if is_plain and not self._has_clients else 1
        self._playing: dict[asyncio.Task[Attempt], tuple[Job, Try]] = {}
        self._ended = deque[asyncio.Task[Attempt]]()
        self._logged = set[type[BaseException]]()
        self._turns = asyncio.Semaphore(rules.max_concurrency or sys.maxsize)
        self._health = Health()
        self._clock = Clock()
        self._numbers = _Numbers(group)
        # Of a turn: what may begin now, and when more may, are asked of one moment, as a wait
        # would miss what comes between two.
        self._now = 0.0
        # Of the last attempts; whether a group has been played; and what began while most failed.
        self._last = deque[Outcome](maxlen=_LAST)
        self._has_played = False
        self._probes: list[Try] = []
        self._wake = asyncio.Event()
        self.done = deque[AttemptGroup]()
        self.news = asyncio.Event()

    async def take(self) -> AttemptGroup:
        """Hand over a group of attempts that is in the file; others may take its place."""
        if self._results is not None:
            await self._results.written()
            self._results.hand_out(self.done[0].spec)
        self._wake.set()
        taken = self.done.popleft()
        self._count()
        return taken

    async def run(self) -> None:
        """Play all tasks."""
        self._clock.start()
        try:
            while True:
                self._wake.clear()
                while self._ended:
                    self._end(self._ended.popleft())
                self._now = time.monotonic()
                if self._begin():
                    await asyncio.sleep(0)
                    continue
                if not self._playing:
                    self._queue.check_players(have_more=not self._source.is_at_end)
                self._count()
                waiting = len(self._queue)  # Some may wait until an env has rested.
                if not (self._playing or waiting) and self._source.is_at_end:
                    return
                seconds = self._health.seconds_left(self._now) if waiting else None
                if self._has_clients:
                    seconds = min(seconds or LOOK_SECONDS, LOOK_SECONDS)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(seconds):
                        await self._wake.wait()
                if self._has_clients:
                    self._queue.look()
        finally:
            self._clock.stop()
            await self._end_all()
            self._playing.clear()
            self._queue.withdraw_all()
            self._count()
            self.news.set()

    def _count(self) -> None:
        """Write the numbers of the moment."""
        playing, waiting = len(self._playing), len(self._queue)
        groups = len(self.done)
        self._numbers.note(self._clock, playing=playing, waiting=waiting, groups_waiting=groups)

    async def _end_all(self) -> None:
        """Read no more tasks, and end what plays."""
        self._source.close()
        if self._playing:
            stop_hardware(self._group)
        for _, one in self._playing.values():
            one.stop("the iterator of play() was closed")
        await surely({*self._playing})
        for task in self._playing:
            # Read, so that asyncio doesn't log an error that is not asked for.
            _ = task.cancelled() or task.exception()

    # -- what begins ------------------------------------------------------------------

    @property
    def _most(self) -> int:
        """Number of attempts that may play at once, and of envs that prepare for the next ones."""
        envs = len(self._queue.free) + len(self._playing)
        return min(envs, self._ahead * (self._rules.max_concurrency or envs))

    def _begin(self) -> bool:
        """Begin attempts on idle envs, and read more tasks while envs are idle.

        Returns True if there are more than one turn of the event loop may begin.
        """
        queue, begun = self._queue, 0
        while True:
            while self._may_begin() and (env_id := queue.next_env(self._rests)):
                if begun == _BURST:
                    return True
                self._start(env_id)
                begun += 1
            room, lacking = max(self._most, 1), queue.lacking()
            is_full = len(self.done) * self._size >= room or len(queue) - lacking >= room
            if is_full or lacking >= _MOST_LACKING or len(self._playing) >= room or not queue.free:
                return False
            spec = self._source.next(self._wake)
            if spec is None:
                return False
            task = queue.add(spec, self._size)
            file = self._results
            if queue.is_done(task) and file is not None and not file.is_handed_out(task.spec):
                self._settle(task)

    def _may_begin(self) -> bool:
        now, health = self._now, self._health
        if health.is_slow and any(probe.goes_well for probe in self._probes):
            health.recover(now)
        if not health.is_slow:
            self._probes.clear()
        return len(self._playing) < self._most and health.may_begin(now)

    def _rests(self, env_id: str) -> bool:
        return self._health.rests(env_id, self._now)

    def _start(self, env_id: str) -> None:
        (job,) = self._queue.take(env_id)
        options = self._queue.players.options(env_id, job.spec)
        episode = self._group.episode(env_id, job.spec.seed, options)
        view = AttemptInPlay(episode, job.spec, job.index, self._clock)
        waited = time.monotonic() - job.since
        one = Try(view, self._agent, self._rules, waited, self._logged, self._turns)
        if self._health.is_slow:
            self._probes.append(one)
            self._health.note_begin(time.monotonic())
        task = asyncio.create_task(one.run())
        self._playing[task] = job, one
        task.add_done_callback(self._note_end)

    def _note_end(self, task: asyncio.Task[Attempt]) -> None:
        self._ended.append(task)
        self._wake.set()

    # -- what ends --------------------------------------------------------------------

    def _end(self, ended: asyncio.Task[Attempt]) -> None:
        """Note the end of a try; its env is idle."""
        queue = self._queue
        job, one = self._playing.pop(ended)
        attempt = ended.result()
        queue.players.note(attempt.outcome)
        if attempt.outcome.is_failure:
            queue.players.refresh()
        queue.release(one.env_id)
        for env_id in queue.players.left_alone:
            queue.free.pop(env_id, None)
        if self._health.note(attempt.outcome, self._most, time.monotonic()):
            queue.excuse([job, *(other for other, _ in self._playing.values())])
        has_ended = queue.end(job, attempt)
        is_retried = not (has_ended or job.task.is_settled)
        self._numbers.note_end(attempt.outcome, is_retried=is_retried)
        if has_ended:
            self._check_failures(attempt.outcome)
            if queue.is_done(job.task):
                self._settle(job.task, one.error)

    def _check_failures(self, outcome: Outcome) -> None:
        """Raise an error if more of the last attempts have failed than may."""
        if self._rules.max_failures is None:
            return
        self._last.append(outcome)
        kinds = Counter(one.kind for one in self._last if one.is_failure)
        if kinds.total() > self._rules.max_failures * _LAST:
            counts = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
            raise RLightningError(
                f"{kinds.total()} of the last {len(self._last)} attempts have failed, more than "
                f"max_failures={self._rules.max_failures:g} of {_LAST}: {counts}; the last one: "
                f"{outcome.kind} on env {outcome.env_id!r}: {outcome.cause}"
            )

    def _settle(self, task: TaskInPlay, error: BaseException | None = None) -> None:
        """Hand over the attempts at a task, and cancel those that are left of it.

        Raises:
            RLightningError: it is the first one, and the agent has failed in every attempt.
        """
        task.is_settled = True
        outcomes = [attempt.outcome for attempt in task.attempts.values()]
        if not self._has_played and all(map(_is_bug, outcomes)):
            raise RLightningError(
                f"the agent has failed in all {len(outcomes)} attempts at the first task, so no "
                f"others are played: {outcomes[0].cause}"
            ) from error
        self._has_played = True
        left: list[Job] = []
        if len(task.attempts) < task.size:
            for job, one in self._playing.values():
                if job.task is task:
                    one.stop(_SURPLUS)
                    left.append(job)
            left += self._queue.withdraw(task)
        for job in left:
            cancelled = Outcome("cancelled", "caller", _SURPLUS, attempt=len(job.failures))
            task.attempts[job.index] = Attempt(
                task.spec, job.index, cancelled, failures=tuple(job.failures)
            )
        attempts = [task.attempts[index] for index in sorted(task.attempts)]
        is_complete = task.num_whole >= needed(self._rules, self._size)
        self.done.append(AttemptGroup(task.spec, attempts, is_complete))
        self.news.set()
