"""`AttemptQueue`: which attempts wait, which env plays what next, and what is tried again.

Rule: first in, first out: an env that is free takes what has waited longest for its entry. It plays
nothing and waits for nothing. `play` plays its attempts with agents, and `evaluate` with a policy
for all envs at once. Every attempt ends once: after its last try, or by withdrawal.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.attempts.players import Players
from rlightning_aio.attempts.rules import is_of_env, is_unnamed, needed, tries_again

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rlightning_aio.attempts.file import ResultsFile
    from rlightning_aio.attempts.records import Attempt
    from rlightning_aio.attempts.rules import Rules
    from rlightning_aio.attempts.spec import EpisodeKey, EpisodeSpec
    from rlightning_aio.outcomes import Outcome

LOOK_SECONDS: Final = 0.2
"""Between looks for clients that have dialled in or left."""


@dataclass(eq=False, slots=True)
class TaskInPlay:
    """A task in progress.

    Attributes:
        size: number of attempts at it.
        attempts: that have ended, by index.
        is_settled: nothing more is wanted of it.
    """

    spec: EpisodeSpec
    size: int = 1
    attempts: dict[int, Attempt] = field(default_factory=dict[int, "Attempt"])
    is_settled: bool = False

    @property
    def num_whole(self) -> int:
        """Number of attempts that have not failed."""
        return sum(not attempt.outcome.is_failure for attempt in self.attempts.values())


@dataclass(eq=False, slots=True)
class Job:
    """An attempt that waits or plays.

    Attributes:
        sub_env: of the env that it waits for.
        since: when it began to wait for an env, in monotonic seconds.
        failures: outcomes of its tries so far.
        num_excused: how many failures, from the first one on, don't count.
    """

    task: TaskInPlay
    index: int
    sub_env: int = 0
    since: float = 0.0
    failures: list[Outcome] = field(default_factory=list["Outcome"])
    num_excused: int = 0

    @property
    def spec(self) -> EpisodeSpec:
        """The task."""
        return self.task.spec

    @property
    def failed_on(self) -> set[str]:
        """The envs on which its tries have failed, bystanders aside."""
        return {one.env_id for one in self.failures if is_of_env(one)}

    @property
    def plays_alone(self) -> bool:
        """A worker has died while it was one of several that were executed."""
        return any(map(is_unnamed, self.failures))


class AttemptQueue:
    """See the module.

    Args:
        group: initialised, with nothing `pending`.
        rules: of the attempts.
        results: a file with attempts that are not played again; others are added to it.

    Attributes:
        players: the envs.
        free: idle envs, the one that has been idle for longest first.
        busy: envs that play.
    """

    def __init__(self, group: Any, rules: Rules, results: ResultsFile | None = None) -> None:
        self._rules, self._results = rules, results
        self.flush()  # Else a line may be missing that was added just before.
        self.players = Players(group)
        self.free = {id_: None for id_ in self.players.entry_of if id_ in self.players.present}
        self.busy: set[str] = set()
        self._waiting: dict[str, deque[Job]] = {}
        # Jobs that only one env may play: of each of its sub-environments, in order.
        self._pinned: dict[str, dict[int, deque[Job]]] = {}
        # Envs whose worker is kept for a job that plays alone.
        self._kept_for: dict[str, Job] = {}
        self._places: set[tuple[EpisodeKey, int, int]] = set()
        self._look_at = 0.0

    # -- what waits -------------------------------------------------------------------

    def add(self, spec: EpisodeSpec, size: int = 1) -> TaskInPlay:
        """Queue the attempts at a task that are not in the file.

        Raises:
            TypeError, ValueError: see `Players.assigned`; or there is a file, and the task was
                queued before.
        """
        task = TaskInPlay(self.players.assigned(spec), size)
        missing = [job for index in range(size) if not self._is_known(job := Job(task, index))]
        if not self.is_done(task):
            for job in missing:
                self._wait(job)
        return task

    def pin(self, spec: EpisodeSpec, index: int, sub_env: int) -> TaskInPlay:
        """Queue episode `index` of a sub-environment, unless it is in the file."""
        task = TaskInPlay(self.players.assigned(spec))
        if not self._is_known(job := Job(task, index, sub_env)):
            self._wait(job)
        return task

    def _is_known(self, job: Job) -> bool:
        """Add an attempt that is in the file; True if it is there."""
        if self._results is None:
            return False
        place = job.spec.key, job.index, job.sub_env
        if place in self._places:
            raise ValueError(
                f"a file of results knows each task once, but {job.spec} is there twice: give it "
                "another seed, or use another file for the next round"
            )
        self._places.add(place)
        found = self._results.find(job.spec, job.index, job.sub_env)
        if found is not None:
            job.task.attempts[job.index] = found
        return found is not None

    def _wait(self, job: Job) -> None:
        spec, job.since = job.spec, time.monotonic()
        if not spec.env_id:
            self._waiting.setdefault(spec.entry, deque()).append(job)
            return
        queue = self._pinned.setdefault(spec.env_id, {}).setdefault(job.sub_env, deque())
        if queue and queue[0].index > job.index:  # It is tried again.
            queue.appendleft(job)
        else:
            queue.append(job)

    def __len__(self) -> int:
        """The number of attempts that wait."""
        return sum(map(len, self.queues()))

    def queues(self) -> Iterable[deque[Job]]:
        """All that waits: for each entry, and for each env that episodes name."""
        pinned = chain.from_iterable(queues.values() for queues in self._pinned.values())
        return chain(self._waiting.values(), pinned)

    def withdraw(self, task: TaskInPlay) -> list[Job]:
        """Remove the attempts at a task that wait, and return them."""
        removed: list[Job] = []
        queues = [self._waiting.get(task.spec.entry, deque[Job]())]
        for queue in (*queues, *self._pinned.get(task.spec.env_id, {}).values()):
            removed += [job for job in queue if job.task is task]
            kept = [job for job in queue if job.task is not task]
            queue.clear()
            queue.extend(kept)
        for job in removed:
            self._keep_nothing_for(job)
        return removed

    def withdraw_all(self) -> list[Job]:
        """Remove all attempts that wait, and return them."""
        removed = [*chain.from_iterable(self.queues())]
        for queue in self.queues():
            queue.clear()
        self._kept_for.clear()
        return removed

    # -- what is played next ----------------------------------------------------------

    def next_env(self, rests: Callable[[str], bool]) -> str | None:
        """The next idle env that doesn't rest and that an attempt waits for; None without one."""
        if not len(self):
            return None
        while True:
            able = (id_ for id_ in self.free if not rests(id_) and self._has_job(id_))
            env_id = next(able, None)
            if env_id is None or not self.players.has_left(env_id):
                return env_id
            del self.free[env_id]

    def _has_job(self, env_id: str) -> bool:
        for queue in self._pinned.get(env_id, {}).values():
            if queue:  # Those of other sub-environments begin together with it.
                return self._may_have(env_id, queue[0])
        return self._shared_job(env_id) is not None

    def _shared_job(self, env_id: str) -> int | None:
        """Position of what an env plays next of those that any env may play."""
        waiting = self._waiting.get(self.players.entry_of[env_id], ())
        return next((k for k, job in enumerate(waiting) if self._may_have(env_id, job)), None)

    def _may_have(self, env_id: str, job: Job) -> bool:
        """Return True if an env may play what waits for its entry, or for itself.

        What has failed on it waits for another env, if there is one. What plays alone has a worker
        kept for it, and waits until all envs there are idle.
        """
        if self._kept_for.get(env_id, job) is not job:
            return False
        if not job.failures:
            return True
        entry_of, left = self.players.entry_of, self.players.present - job.failed_on
        has_others = not job.spec.env_id and any(entry_of[one] == job.spec.entry for one in left)
        if env_id in job.failed_on and has_others:
            return False
        if not job.plays_alone:
            return True
        if env_id not in self._kept_for:
            if any(self._kept_for.get(one) is job for one in left):
                return False
            self._kept_for.update(dict.fromkeys(self.players.worker_of[env_id], job))
        return self.players.present.intersection(self.players.worker_of[env_id]) <= {*self.free}

    def _keep_nothing_for(self, job: Job) -> None:
        if self._kept_for:
            self._kept_for = {one: kept for one, kept in self._kept_for.items() if kept is not job}

    def take(self, env_id: str) -> list[Job]:
        """Remove what an idle env plays next, which it begins now: one of each sub-environment.

        Episodes of sub-environments begin together. After a loss they may have played different
        numbers, so those begin that have played the fewest.
        """
        pinned = [queue for queue in self._pinned.get(env_id, {}).values() if queue]
        position = None if pinned else self._shared_job(env_id)
        del self.free[env_id]
        self.busy.add(env_id)
        if pinned:
            first = min(queue[0].index for queue in pinned)
            return [queue.popleft() for queue in pinned if queue[0].index == first]
        assert position is not None
        waiting = self._waiting[self.players.entry_of[env_id]]
        job = waiting[position]
        del waiting[position]
        return [job]

    def take_next(self, env_id: str, sub_env: int) -> Job | None:
        """Remove what a sub-environment plays next that resets itself.

        None if nothing waits for it, or if that needs a reset with a seed or options.
        """
        queue = self._pinned.get(env_id, {}).get(sub_env)
        if not queue or queue[0].spec.seed is not None or queue[0].spec.options is not None:
            return None
        return queue.popleft()

    # -- what has ended ---------------------------------------------------------------

    def release(self, env_id: str) -> None:
        """Let an env that is idle now play something else, if it is there."""
        self.busy.discard(env_id)
        if env_id in self.players.present:
            self.free[env_id] = None

    def end(self, job: Job, attempt: Attempt, *, is_last: bool = False) -> bool:
        """Queue an attempt again that has failed, or note it; True if it is noted.

        It `is_last` if nobody could try it again.
        """
        outcome = attempt.outcome = replace(attempt.outcome, attempt=len(job.failures))
        self._keep_nothing_for(job)
        if job.task.is_settled:
            return False
        if not is_last and tries_again(self._rules, outcome, job.failures, job.num_excused):
            job.failures.append(outcome)
            self._wait(job)
            return False
        attempt.failures = tuple(job.failures)
        job.task.attempts[job.index] = attempt
        if self._results is not None:
            self._results.add(attempt)
        return True

    def excuse(self, playing: Iterable[Job]) -> None:
        """Count no failure so far, nor the next one of what plays: an outage has begun."""
        for job in chain.from_iterable(self.queues()):
            job.num_excused = len(job.failures)
        for job in playing:
            job.num_excused = len(job.failures) + 1

    def flush(self) -> None:
        """Wait until what has ended is in the file."""
        if self._results is not None:
            self._results.flush()

    def is_done(self, task: TaskInPlay) -> bool:
        """A task needs no further attempts."""
        whole = needed(self._rules, task.size)
        return len(task.attempts) == task.size or task.num_whole >= whole

    # -- envs that are not there -----------------------------------------------------------

    def lacking(self) -> int:
        """The number of attempts that wait for envs while none of these is free or busy."""
        entry_of = self.players.entry_of
        entries, pinned = dict.fromkeys(self._entries()), dict.fromkeys(self._pinned_to())
        for env_id in chain(self.free, self.busy):  # Few are looked at: each entry has many.
            if not entries and not pinned:
                break
            entries.pop(entry_of[env_id], None)
            pinned.pop(env_id, None)
        queues = chain.from_iterable(self._pinned[env_id].values() for env_id in pinned)
        return sum(len(self._waiting[entry]) for entry in entries) + sum(map(len, queues))

    def _entries(self) -> list[str]:
        """The entries of attempts that any of their envs may play."""
        return [entry for entry, waiting in self._waiting.items() if waiting]

    def _pinned_to(self) -> list[str]:
        return [env_id for env_id, queues in self._pinned.items() if any(queues.values())]

    def look(self, *, at_once: bool = False) -> None:
        """Look which envs are there, a few times in a second: those that are not busy are free.

        Looking at all places of an env_server takes its time.
        """
        now = time.monotonic()
        if now < self._look_at and not at_once:
            return
        self._look_at = now + LOOK_SECONDS
        self.players.refresh()
        present = self.players.present - self.busy
        for env_id in self.free.keys() - present:
            del self.free[env_id]
        for env_id in self.players.entry_of:  # In their order.
            if env_id in present:
                self.free.setdefault(env_id)

    def check_players(self, *, have_more: bool) -> None:
        """Raise an error if attempts wait, or `have_more` to come, for envs that only their user
        resets.
        """
        players, alone = self.players, self.players.left_alone
        left = players.entries_left()
        is_possible = left.issuperset(self._entries()) and alone.isdisjoint(self._pinned_to())
        if not (is_possible and (left or not have_more)):
            raise players.refusal(min(alone))
