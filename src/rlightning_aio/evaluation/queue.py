"""`QueuePlay`: plays a queue of episodes on a group's envs.

Rule: each episode is played to its end once, by any free env that can play its task. What an env
loses with its worker, or by an exception, is queued again, up to a number of attempts. An env whose
worker is not replaced leaves, and the others play its episodes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.attempts.players import Players
from rlightning_aio.attempts.waiting import WaitingEpisodes
from rlightning_aio.batch.contents import all_agents, summed_rewards
from rlightning_aio.errors import EnvFault, WorkerDied
from rlightning_aio.evaluation.episode_video import EpisodeVideo, Filming
from rlightning_aio.evaluation.outcomes import (
    EndlessEpisodes,
    success_of,
)
from rlightning_aio.evaluation.records import EpisodeRecord, QueueEvaluation
from rlightning_aio.outcomes import is_bystanders
from rlightning_aio.policies.answers import answers_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rlightning_aio.attempts.spec import EpisodeSpec
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.collecting.procedure import Procedure
    from rlightning_aio.evaluation.results_file import ResultsFile
    from rlightning_aio.outcomes import Outcome
    from rlightning_aio.types import EnvMeta

__all__ = ["QueuePlay", "QueueRules"]


@dataclass(frozen=True, slots=True)
class QueueRules:
    """The options of an evaluation of a queue; see `evaluate`."""

    min_results: int | None
    max_attempts: int
    results: ResultsFile | None
    video: EpisodeVideo | None
    on_episode: Callable[[EpisodeRecord], None] | None


@dataclass(slots=True)
class Attempts:
    """An episode that is waiting or playing, and why earlier attempts were lost."""

    spec: EpisodeSpec
    lost: list[str] = field(default_factory=list[str])


class QueuePlay:
    """An evaluation of a queue in progress.

    Args:
        group: an initialised group.
        policy: see `evaluate`.
        episodes: to play; those of a task in this order.
        rules: the options.

    Raises:
        ValueError: see `evaluate`.
    """

    def __init__(
        self,
        group: Any,
        policy: Callable[[BatchedData], Any],
        episodes: Iterable[EpisodeSpec],
        rules: QueueRules,
    ) -> None:
        self._group, self._policy, self._rules = group, policy, rules
        metas: list[EnvMeta] = group.metas
        _check_single(metas)
        self._metas = {meta.env_id: meta for meta in metas}
        self._players = Players(group)
        self._entry_of = self._players.entry_of
        # Multi-agent envs with different agents don't stack.
        self._separate = len({meta.agents for meta in metas}) > 1
        self._places = {meta.env_id: place for place, meta in enumerate(metas)}
        self._reward = np.zeros(len(metas))
        self._length = np.zeros(len(metas), np.int64)
        self._endless = EndlessEpisodes()
        self._found = QueueEvaluation()
        self._waiting = {entry: WaitingEpisodes[Attempts]() for entry in self._entry_of.values()}
        self._playing: dict[str, Attempts] = {}
        self._idle = dict.fromkeys(self._metas)
        """Envs that may begin an episode, in order."""
        self._pending: set[str] = set()
        """Envs with a request in flight."""
        self._gone = self._players.gone
        self._fault: EnvFault | None = None
        """The last one."""
        self._ended = deque[EpisodeRecord]()
        """Episodes that the last results ended, to be recorded."""
        self._fill(episodes)
        self._filming = None if rules.video is None else Filming(group, rules.video)

    # -- the queue --------------------------------------------------------------------

    def _fill(self, episodes: Iterable[EpisodeSpec]) -> None:
        """Queue the episodes that were not played, and add the records of the others."""
        specs = [self._players.assigned(spec) for spec in episodes]
        by_key = {spec.key: spec for spec in specs}
        if len(by_key) < len(specs):
            twice = next(spec for spec in specs if by_key[spec.key] is not spec)
            raise ValueError(f"each episode is played once, but the queue has {twice} twice")
        results = self._rules.results
        played = {} if results is None else {record.key: record for record in results.played}
        lost = {} if results is None else results.lost
        self._found.records += [record for key, record in played.items() if key in by_key]
        for key, spec in by_key.items():
            if key not in played:
                attempts = Attempts(spec, [*lost.get(key, ())])
                if len(attempts.lost) < self._rules.max_attempts:
                    self._waiting[spec.entry].add(attempts)
                else:
                    self._fail("", attempts)

    # -- the loop ---------------------------------------------------------------------

    def to_the_end(self) -> Procedure[QueueEvaluation]:
        """Play all episodes."""
        while True:
            yield from self._begin_episodes()
            self._check_players()
            if not self._pending:
                return self._found
            try:
                batch: BatchedData
                batch, _ = yield lambda: self._group.collect_async(
                    min_results=self._rules.min_results
                )
            except EnvFault as fault:
                self._note_fault(fault)
            else:
                yield from self._continue(batch)

    def _begin_episodes(self) -> Procedure[None]:
        """Record ended episodes, and begin others in idle envs."""
        while True:
            while self._ended:
                yield from self._keep(self._ended.popleft())
            env_id = next((id_ for id_ in self._idle if self._waiting[self._entry_of[id_]]), None)
            if env_id is None:
                return
            del self._idle[env_id]
            attempts = self._players.take(env_id, self._waiting[self._entry_of[env_id]])
            self._playing[env_id] = attempts
            try:
                yield from self._begin(env_id, attempts.spec)
            except WorkerDied as fault:
                self._note_fault(fault)

    def _begin(self, env_id: str, spec: EpisodeSpec) -> Procedure[None]:
        if self._filming is not None:
            yield from self._filming.begin(env_id, spec)
        place = self._places[env_id]
        self._reward[place] = self._length[place] = 0
        options = self._players.options(env_id, spec)
        self._group.reset_async(seed={env_id: spec.seed}, options=options, env_ids=[env_id])
        self._pending.add(env_id)

    def _keep(self, record: EpisodeRecord) -> Procedure[None]:
        """Record the outcome of an episode."""
        if self._filming is not None:
            try:
                yield from self._filming.end(record.env_id, record)
            except WorkerDied as fault:
                self._filming.drop(record.env_id)
                self._note_fault(fault)
        self._found.records.append(record)
        if self._rules.results is not None:
            self._rules.results.add(record)
        if self._rules.on_episode is not None:
            self._rules.on_episode(record)

    def _continue(self, batch: BatchedData) -> Procedure[None]:
        """Add results to their episodes, and begin others or step their envs."""
        env_ids = batch.env_ids()
        self._pending.difference_update(env_ids)
        for part in batch.by_entry().values() if self._separate else (batch,):
            self._record(part)
        yield from self._begin_episodes()
        rows = [
            row
            for row, env_id in enumerate(env_ids)
            if env_id in self._playing and env_id not in self._pending
        ]
        if rows:
            stepped = batch if len(rows) == len(batch) else batch.take(rows)
            answer = yield lambda: self._policy(stepped)
            space = self._metas[env_ids[rows[0]]].action_space
            for part in answers_of(stepped, answer, lambda: space):
                self._step(part)

    def _step(self, batch: BatchedData) -> None:
        """Send a step to each env whose worker was not given up."""
        while len(batch):
            try:
                self._group.step_async(batch)
            except WorkerDied as fault:
                self._note_fault(fault)
                env_ids = batch.env_ids()
                batch = batch.take([k for k, id_ in enumerate(env_ids) if id_ not in self._gone])
            else:
                self._pending.update(batch.env_ids())
                return

    # -- results ----------------------------------------------------------------------

    def _record(self, batch: BatchedData) -> None:
        places, env_ids = batch.index, batch.env_ids()
        stepped = ~batch.is_reset
        rewards = np.where(stepped, summed_rewards(batch.reward), 0.0)
        with np.errstate(over="ignore", invalid="ignore"):  # The return shows it.
            self._reward[places] += rewards
        self._length[places] += stepped
        self._endless.look(self._length[places], env_ids)
        restarted = batch.restarted
        ended = stepped & all_agents(batch.done) & ~restarted
        rows: list[int] = np.flatnonzero(ended | restarted).tolist()
        if rows:
            for row, info in zip(rows, batch.take(rows).info(), strict=True):
                env_id = env_ids[row]
                if restarted[row]:
                    lost: Outcome = info["outcome"]
                    self._lose(env_id, lost.cause, is_blamed=not is_bystanders(lost))
                else:
                    self._end(env_id, info)
                if env_id not in self._gone:
                    self._idle[env_id] = None

    def _end(self, env_id: str, info: dict[str, Any]) -> None:
        """Note that the episode of an env was played to its end."""
        place = self._places[env_id]
        total, length = float(self._reward[place]), int(self._length[place])
        record = self._outcome(env_id, self._playing.pop(env_id))
        self._ended.append(
            replace(record, total_reward=total, length=length, success=success_of(info))
        )

    def _outcome(self, env_id: str, attempts: Attempts) -> EpisodeRecord:
        spec = attempts.spec
        return EpisodeRecord(
            spec.entry, spec.task, spec.seed, spec.options, env_id,
            total_reward=None, length=None, success=None, lost=tuple(attempts.lost),
        )  # fmt: skip

    def _lose(self, env_id: str, cause: str, *, is_blamed: bool) -> None:
        """Queue the lost episode of an env again, or note that it failed.

        It was an attempt only if the env itself may be at fault, not a neighbour in its worker.
        """
        attempts = self._playing.pop(env_id, None)
        if self._filming is not None:
            self._filming.drop(env_id)
        if attempts is None:
            return
        if is_blamed:
            attempts.lost.append(cause)
            if self._rules.results is not None:
                self._rules.results.add_lost(attempts.spec, cause)
        if len(attempts.lost) < self._rules.max_attempts:
            self._waiting[attempts.spec.entry].add(attempts)
        else:
            self._fail(env_id, attempts)

    def _fail(self, env_id: str, attempts: Attempts) -> None:
        """Note that an episode was lost as often as it may be."""
        self._ended.append(replace(self._outcome(env_id, attempts), cause=attempts.lost[-1]))

    # -- faults -----------------------------------------------------------------------

    def _note_fault(self, fault: EnvFault) -> None:
        """Queue the episodes again that an error ended; drop envs that are not replaced."""
        self._fault = fault
        struck, blamed = {fault.env_id}, {fault.env_id}
        if isinstance(fault, WorkerDied):
            blamed.update(fault.suspects)
            # The env at fault may be another one, whose own request a replacement answers.
            struck = {*fault.env_ids}
            self._players.refresh()
        self._pending -= struck
        # A ready result of an env that is gone can still be collected.
        for env_id in (struck | self._gone) - self._pending:
            self._lose(env_id, _cause(fault), is_blamed=env_id in blamed)
            if env_id not in self._gone:
                self._idle[env_id] = None
        for env_id in self._gone:
            self._idle.pop(env_id, None)

    def _check_players(self) -> None:
        """Raise the last fault if no env is left for an entry's episodes."""
        waiting = [entry for entry, episodes in self._waiting.items() if episodes]
        if self._fault is not None and not self._players.can_play(waiting):
            raise self._fault


def _cause(fault: EnvFault) -> str:
    """Return the first line of an error."""
    return str(fault).strip().partition("\n")[0]


def _check_single(metas: Sequence[EnvMeta]) -> None:
    for meta in metas:
        if meta.num_envs > 1:
            raise ValueError(
                f"{meta.env_id} has {meta.num_envs} sub-environments, but an env plays one episode "
                "of the queue at a time: num_envs: 1, and num_workers for the number of envs"
            )
