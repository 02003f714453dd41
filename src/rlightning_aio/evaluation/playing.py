"""`PolicyPlay`: plays the attempts of a queue with a policy for all envs at once.

Rule: results are stepped first come, first served. What an env loses with its worker, or by an
exception, goes back to the queue. Sub-environments begin together; those that reset themselves go
on with their next episodes until all are played.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import deque
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.group.api.facade import request_number
from rlightning_aio.attempts.health import Health
from rlightning_aio.attempts.records import Attempt, success_of
from rlightning_aio.batch.contents import ended_episodes, lost_rows, readable
from rlightning_aio.batch.parts import all_agents
from rlightning_aio.errors import EnvAway, EnvFault, RLightningError, WorkerDied
from rlightning_aio.evaluation.evaluation import Evaluation
from rlightning_aio.outcomes import Outcome, bystanders, own_end
from rlightning_aio.policies.answers import answers_of, parts_by_policy

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.attempts.queue import AttemptQueue, Job, TaskInPlay
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.collecting.procedure import Procedure
    from rlightning_aio.evaluation.films import Films
    from rlightning_aio.types import EnvMeta

_PATIENCE_SECONDS: Final = 1.0
"""For results of an evaluation that ends in an error; what takes longer is aborted."""
_log = logging.getLogger("rlightning_aio")


class PolicyPlay:
    """An evaluation in progress. Arrays have an element for each sub-environment of the group.

    Args:
        group: an initialised group.
        policies: functions of a batch by entry; one for all envs has the name ``""``.
        queue: of the episodes.
        films: of the first episodes.
        min_results, on_episode: see `evaluate`.
    """

    def __init__(
        self,
        group: Any,
        policies: dict[str, Callable[[BatchedData], Any]],
        queue: AttemptQueue,
        films: Films,
        min_results: int,
        on_episode: Callable[[Attempt], None] | None,
    ) -> None:
        self._group, self._policies, self._queue = group, policies, queue
        self._films, self._min_results, self._on_episode = films, min_results, on_episode
        self._found = Evaluation()
        metas: list[EnvMeta] = group.metas
        self._metas = {meta.env_id: meta for meta in metas}
        ends = np.cumsum([meta.num_envs for meta in metas]).tolist()
        self._places = {
            meta.env_id: range(end - meta.num_envs, end)
            for meta, end in zip(metas, ends, strict=True)
        }
        # Results of different shapes don't stack.
        self._separate = len({(meta.num_envs, meta.agents) for meta in metas}) > 1
        self._jobs: dict[int, Job] = {}  # By place.
        self._counts = np.zeros(ends[-1], np.bool_)
        """An episode of the queue is going on; False before the result of its reset."""
        self._has_clients = len(group) > group.size()
        self._pending: set[str] = set()
        """Envs with a request in flight."""
        self._begun: dict[str, int] = {}
        """Those of them that a reset begins, with the number of that."""
        self._ended: deque[tuple[Job, Attempt]] = deque()
        """Episodes that the last results ended, to be noted."""
        self._has_warned = False
        self._health = Health()

    # -- the loop ---------------------------------------------------------------------

    def to_the_end(self) -> Procedure[Evaluation]:
        """Play all episodes."""
        yield from self._films.check()
        while True:
            self._begin_episodes()
            if not self._pending:
                if not len(self._queue):
                    return self._found
                self._end_waiting()
                continue
            try:
                batch: BatchedData
                batch, _ = yield lambda: self._group.collect_async(min_results=self._min_results)
            except EnvFault as fault:
                self._note_fault(fault)
            else:
                yield from self._continue(batch)

    def abandon(self) -> Procedure[None]:
        """End what was sent, after an error: the group is idle then."""
        for _ in self._group.env_ids:  # Each call may raise what another env has met.
            with contextlib.suppress(RLightningError):  # Its episode is lost anyway.
                if self._group.pending:
                    yield partial(self._group.drain, _PATIENCE_SECONDS)

    def close(self) -> None:
        """Delete the films of episodes that have no end."""
        self._films.close()

    def _begin_episodes(self) -> None:
        """Note ended episodes, and begin others in idle envs."""
        if self._has_clients:
            self._queue.look()
        while True:
            while self._ended:
                self._keep(*self._ended.popleft())
            env_id = self._queue.next_env(self._rests)
            if env_id is None:
                return
            jobs = self._queue.take(env_id)
            first = self._places[env_id].start
            self._jobs.update((first + job.sub_env, job) for job in jobs)
            try:
                self._begin(env_id, jobs[0])
            except EnvFault as fault:
                self._note_fault(fault)

    def _rests(self, env_id: str) -> bool:
        return self._health.rests(env_id, time.monotonic())

    def _end_waiting(self) -> None:
        """End what waits while no env plays: only envs that are not there could play it."""
        self._queue.look(at_once=True)
        self._health = Health()  # Envs rest only while others play.
        if self._queue.next_env(self._rests) is not None:
            return
        players = self._queue.players
        for job in self._queue.withdraw_all():
            env_id = job.spec.env_id
            alone = players.left_alone & {env_id} if env_id else players.left_alone
            if job.failures:  # Those say more.
                outcome = job.failures.pop()
            else:
                away = "no client is there that could play it"
                cause = str(players.refusal(min(alone))) if alone else away
                outcome = Outcome("env_away", "infrastructure", cause, env_id)
            attempt = Attempt(job.spec, job.index, outcome, sub_env=job.sub_env)
            self._keep(job, attempt, is_last=True)

    def _begin(self, env_id: str, job: Job) -> None:
        seed, options = job.spec.seed, self._queue.players.options(env_id, job.spec)
        seeds = None if seed is None else {env_id: seed - job.sub_env}
        self._group.reset_async(seed=seeds, options=options, env_ids=[env_id])
        self._pending.add(env_id)
        self._begun[env_id] = request_number(self._group, env_id)
        self._films.begin(env_id, job)

    def _keep(self, job: Job, attempt: Attempt, *, is_last: bool = False) -> None:
        """Note what came of an episode."""
        self._health.note_env(attempt.outcome, time.monotonic())
        if not attempt.outcome.is_failure:
            self._films.keep(attempt)
        if not self._queue.end(job, attempt, is_last=is_last):
            return
        self._queue.flush()
        if attempt.outcome.is_failure and not self._has_warned:
            self._has_warned = True
            _log.warning(
                "an episode has failed: %s: %s; the figures leave such episodes out, and `failed` "
                "of the evaluation has them",
                attempt.spec,
                attempt.outcome.cause,
            )
        self._note(attempt)

    def note_known(self, tasks: list[TaskInPlay]) -> None:
        """Note the episodes that were in the file."""
        for task in tasks:
            for attempt in task.attempts.values():
                self._note(attempt)

    def _note(self, attempt: Attempt) -> None:
        self._found.attempts.append(attempt)
        if self._on_episode is not None:
            self._on_episode(attempt)

    def _continue(self, batch: BatchedData) -> Procedure[None]:
        """Add results to their episodes, and begin others or step their envs."""
        self._pending.difference_update(batch.env_ids())
        batch, faults = readable(batch)
        for fault in faults:
            self._note_fault(fault)
        if not len(batch):
            return
        env_ids = batch.env_ids()
        # Before a frame is asked for, which is another request.
        as_asked = {env_id for env_id in env_ids if self._is_begun_as_asked(env_id)}
        yield from self._film(env_ids)
        for part in batch.by_entry().values() if self._separate else (batch,):
            self._record(part, as_asked)
        for env_id in env_ids:
            self._begun.pop(env_id, None)
        self._begin_episodes()
        rows = [
            row
            for row, env_id in enumerate(env_ids)
            if env_id not in self._pending and self._plays(env_id)
        ]
        if rows:
            stepped = batch if len(rows) == len(batch) else batch.take(rows)
            for name, part in parts_by_policy(stepped, self._policies):
                answer = yield partial(self._policies[name], part)
                space = self._metas[part.env_ids()[0]].action_space
                for responses in answers_of(part, answer, space):
                    self._step(responses)

    def _film(self, env_ids: list[str]) -> Procedure[None]:
        for env_id in [one for one in self._films.filmed if one in env_ids]:
            try:
                yield from self._films.see(env_id)
            except EnvFault as fault:
                self._note_fault(fault)

    def _plays(self, env_id: str) -> bool:
        return any(place in self._jobs for place in self._places[env_id])

    def _step(self, batch: BatchedData) -> None:
        """Send a step to each env but those that were lost meanwhile, which it raises."""
        while len(batch):
            try:
                self._group.step_async(batch)
            except EnvFault as fault:
                struck, env_ids = self._note_fault(fault), batch.env_ids()
                batch = batch.take([k for k, id_ in enumerate(env_ids) if id_ not in struck])
            else:
                self._pending.update(batch.env_ids())
                return

    # -- results ----------------------------------------------------------------------

    def _record(self, batch: BatchedData, as_asked: set[str]) -> None:
        """Note what results end and begin; envs that began `as_asked` have lost nothing."""
        env_ids = batch.env_ids()
        lost = [row for row in lost_rows(batch) if env_ids[row] not in as_asked]
        if lost:
            self._note_losses(batch, lost)
        places, begins = batch.index.reshape(-1), batch.is_reset.reshape(-1)
        done = all_agents(batch.done)
        ended = self._counts[places] & ~begins & done.reshape(-1)
        if ended.any():
            self._note_ends(batch, ended.reshape(len(batch), -1))
        begins |= self._begun_again(env_ids, done).reshape(-1)
        begins = begins.reshape(len(batch), -1)
        begins[lost] = False  # They are reset once more.
        if begins.any():
            self._note_begins(env_ids, begins)

    def _is_begun_as_asked(self, env_id: str) -> bool:
        """Return True if an env answers a reset that was asked for once: it may have lost what it
        did before that, and nothing since.
        """
        return self._begun.get(env_id) == request_number(self._group, env_id)

    def _begun_again(self, env_ids: list[str], done: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of sub-environments that have begun the next episode in the step that ended one."""
        same_step = np.array([self._metas[id_].autoreset == "same_step" for id_ in env_ids])
        return (done.T & same_step).T

    def _note_begins(self, env_ids: list[str], begins: NDArray[np.bool_]) -> None:
        """Begin to count the episodes of the queue; others may begin in sub-environments."""
        for row in np.flatnonzero(begins.any(axis=1)).tolist():
            env_id = env_ids[row]
            for sub_env in np.flatnonzero(begins[row]).tolist():
                place = self._places[env_id][sub_env]
                if place not in self._jobs and env_id not in self._begun:
                    self._take_next(env_id, sub_env)
                self._counts[place] = place in self._jobs

    def _take_next(self, env_id: str, sub_env: int) -> None:
        """Give a sub-environment that resets itself its next episode."""
        if not self._films.are_wanted and self._metas[env_id].autoreset != "disabled":
            job = self._queue.take_next(env_id, sub_env)
            if job is not None:
                self._jobs[self._places[env_id][sub_env]] = job

    def _note_ends(self, batch: BatchedData, ended: NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(ended.any(axis=1)).tolist()
        env_ids = batch.env_ids()
        terminated = all_agents(batch.terminated).reshape(len(batch), -1)
        for row, (sums, info) in zip(rows, ended_episodes(batch, rows), strict=True):
            env_id = env_ids[row]
            returns, lengths = np.atleast_1d(sums["r"]), np.atleast_1d(sums["l"])
            for sub_env in np.flatnonzero(ended[row]).tolist():
                outcome = own_end(env_id, info, terminated=bool(terminated[row, sub_env]))
                reward, length = float(returns[sub_env]), int(lengths[sub_env])
                self._end(env_id, sub_env, outcome, reward, length, success_of(info, sub_env))
                self._take_next(env_id, sub_env)
            self._release(env_id)

    def _end(
        self,
        env_id: str,
        sub_env: int,
        outcome: Outcome,
        reward: float = 0.0,
        length: int = 0,
        success: float | None = None,
    ) -> None:
        """Note that the episode of a sub-environment has ended, if it was one of the queue."""
        place = self._places[env_id][sub_env]
        job = self._jobs.pop(place, None)
        if job is None:
            return
        if not (outcome.is_failure or math.isfinite(reward)):
            cause = "returned no reward" if math.isnan(reward) else f"rewards add up to {reward}"
            outcome = Outcome("env_raised", "env", cause, env_id)
        attempt = Attempt(job.spec, job.index, outcome, sub_env=job.sub_env)
        if not outcome.is_failure:
            attempt.reward, attempt.length, attempt.success_value = reward, length, success
        self._counts[place] = False
        self._ended.append((job, attempt))

    def _release(self, env_id: str) -> None:
        """Let an env begin other episodes if it plays none."""
        if not self._plays(env_id):
            self._queue.release(env_id)

    # -- faults -----------------------------------------------------------------------

    def _note_losses(self, batch: BatchedData, rows: list[int]) -> None:
        """Note what envs have lost whose workers were replaced."""
        env_ids = batch.env_ids()
        for row, info in zip(rows, batch.take(rows).info(), strict=True):
            self._lose(env_ids[row], info["outcome"])

    def _lose(self, env_id: str, outcome: Outcome) -> None:
        """Note that an env has lost its episodes."""
        self._films.drop(env_id)
        for sub_env in range(len(self._places[env_id])):
            self._end(env_id, sub_env, outcome)
        self._queue.players.note(replace(outcome, env_id=env_id))
        self._release(env_id)

    def _note_fault(self, fault: EnvFault) -> set[str]:
        """Note the episodes that an error ended; return the envs."""
        struck, is_named = {fault.env_id}, fault.outcome.blame != "infrastructure"
        if isinstance(fault, WorkerDied | EnvAway):
            # The env at fault may be another one, whose own request a replacement answers.
            struck = {*fault.env_ids} or struck
        self._pending -= struck
        for env_id in struck:
            outcome = replace(fault.outcome, env_id=env_id)
            if is_named and env_id != fault.env_id:
                outcome = bystanders(outcome.cause, fault.env_id, env_id)
            self._begun.pop(env_id, None)
            self._lose(env_id, outcome)
        return struck
