"""`play`: groups of attempts at tasks, by agents that are coroutines.

Rule: an engine of its own task keeps the envs busy, however long its caller takes for a group of
attempts; no more tasks are begun while as many attempts wait for the caller as may play at once.
Every try of an attempt is a task. It ends within a second of its cancellation, whatever the agent
does, and its env is idle or replaced then.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.attempts.episode import AttemptInPlay
from rlightning_aio.attempts.queue import AttemptQueue
from rlightning_aio.attempts.records import Attempt, AttemptGroup
from rlightning_aio.attempts.rules import Rules, needed
from rlightning_aio.attempts.tasks import TaskSource
from rlightning_aio.attempts.tries import Try, surely
from rlightning_aio.errors import EnvBusy, RLightningError, WorkerDied
from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterable, Iterable

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts.file import ResultsFile
    from rlightning_aio.attempts.queue import Job, TaskInPlay
    from rlightning_aio.attempts.tries import Agent

__all__ = ["play"]

_BURST: Final = 16
"""Most attempts that begin in one turn of the event loop, so that it is free for others."""
_LOOK_SECONDS: Final = 0.2
"""Between looks for clients that have dialled in."""
_MOST_LACKING: Final = 1000
"""Most attempts that wait for entries without an env while tasks are read for the others."""
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
        results: a file to which attempts are added. Those that it has are not played again: tasks
            that are done there are left out, others come with attempts from the file, without
            their observations.

    Groups come as they are done. When the iterator ends, is closed (`contextlib.aclosing`) or is
    cancelled, every env is idle or is being replaced, and no task is left.

    Raises:
        EnvBusy: an env has a request in flight, or a result that was not collected.
        ValueError: `size` is below 1, or no entry can play a task, or more than one can, or there
            is a file, and a task is there twice.
        WorkerDied, EnvHung: all envs that could play a task are gone for good.
    """
    if size < 1:
        raise ValueError(f"size must be at least 1, not {size!r}")
    if busy := group.pending:
        raise EnvBusy(f"{busy[0]!r} has a request whose result was not collected; collect it")
    engine = _Engine(group, TaskSource(tasks), agent, size, rules or Rules(), results)
    running = asyncio.create_task(engine.run())
    try:
        while True:
            while engine.done:
                yield engine.take()
            if running.done():
                running.result()  # Raises its error, if it has one.
                return
            await engine.news.wait()
            engine.news.clear()
    finally:
        running.cancel()
        await asyncio.wait({running})  # Cancelled once more, it ends all the same.
        _ = running.cancelled() or running.exception()


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
        self._queue = AttemptQueue(group, rules, results)
        self._has_clients = len(group) > group.size()
        self._playing: dict[asyncio.Task[Attempt], tuple[Job, Try]] = {}
        self._ended = deque[asyncio.Task[Attempt]]()
        self._look_at = 0.0
        self._logged = set[type[BaseException]]()
        self._wake = asyncio.Event()
        self.done = deque[AttemptGroup]()
        self.news = asyncio.Event()

    def take(self) -> AttemptGroup:
        """Hand over a group of attempts; others may take its place."""
        self._wake.set()
        return self.done.popleft()

    async def run(self) -> None:
        """Play all tasks."""
        try:
            while True:
                self._wake.clear()
                while self._ended:
                    self._end(self._ended.popleft())
                if self._begin():
                    await asyncio.sleep(0)
                    continue
                self._check_envs()
                lacking = self._num_lacking()
                if not self._playing and not lacking and self._source.is_at_end:
                    return
                if not lacking and not self._has_clients:
                    await self._wake.wait()
                    continue
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_LOOK_SECONDS):
                        await self._wake.wait()
                self._look()
        finally:
            self._source.close()
            for _, one in self._playing.values():
                one.stop("the iterator of play() was closed")
            await surely({*self._playing})
            for task in self._playing:
                # Read, so that asyncio doesn't log an error that is not asked for.
                _ = task.cancelled() or task.exception()
            self.news.set()

    # -- what begins ------------------------------------------------------------------

    @property
    def _most(self) -> int:
        """Number of attempts that may play at once."""
        envs = len(self._queue.free) + len(self._playing)
        return min(envs, self._rules.max_concurrency or envs)

    def _begin(self) -> bool:
        """Begin attempts on idle envs, and read more tasks while envs are idle.

        Returns True if there are more than one turn of the event loop may begin.
        """
        queue, begun = self._queue, 0
        while True:
            while len(self._playing) < self._most and (env_id := queue.next_env()):
                if begun == _BURST:
                    return True
                self._start(env_id)
                begun += 1
            room, lacking = max(self._most, 1), self._num_lacking()
            is_full = len(self.done) * self._size >= room or len(queue) - lacking >= room
            if is_full or lacking >= _MOST_LACKING or len(self._playing) >= room or not queue.free:
                return False
            spec = self._source.next(self._wake)
            if spec is None:
                return False
            queue.add(spec, self._size)

    def _start(self, env_id: str) -> None:
        (job,) = self._queue.take(env_id)
        options = self._queue.players.options(env_id, job.spec)
        episode = self._group.episode(env_id, job.spec.seed, options)
        view = AttemptInPlay(episode, job.spec, job.index)
        one = Try(view, self._agent, self._rules, time.monotonic() - job.since, self._logged)
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
        if isinstance(one.error, WorkerDied):
            queue.fault = one.error
        if not attempt.outcome.is_failure or one.env_id in queue.players.refresh():
            queue.free[one.env_id] = None
        for env_id in queue.players.gone:
            queue.free.pop(env_id, None)
        if queue.end(job, attempt) and queue.is_done(job.task):
            self._settle(job.task)

    def _settle(self, task: TaskInPlay) -> None:
        """Hand over the attempts at a task, and cancel those that are left of it."""
        task.is_settled = True
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

    # -- envs that are not there ------------------------------------------------------

    def _num_lacking(self) -> int:
        """Number of attempts that wait for an entry of which no env is there."""
        return self._queue.lacking(one.env_id for _, one in self._playing.values())

    def _check_envs(self) -> None:
        """Raise the last fault if attempts wait for an env that won't come."""
        queue = self._queue
        if not (queue.free or self._playing or self._has_clients or self._source.is_at_end):
            raise queue.fault or RLightningError("no env of this group is left that could play")
        queue.check_players()

    def _look(self) -> None:
        """Look for clients that have come, or come back, a few times in a second."""
        if time.monotonic() < self._look_at:
            return
        self._look_at = time.monotonic() + _LOOK_SECONDS
        busy = {one.env_id for _, one in self._playing.values()}
        for env_id in self._queue.players.refresh() - busy:
            self._queue.free.setdefault(env_id)
