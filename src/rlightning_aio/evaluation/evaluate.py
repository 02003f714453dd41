"""`evaluate`, and its form that plays the same number of episodes of each env.

Rule: results are stepped first come, first served. The choice of episodes is made before the first
step, so it doesn't depend on their lengths. An env that resets itself is stepped
until each sub-environment has played its number; further episodes are ignored.
"""

from __future__ import annotations

from collections import Counter
from operator import index
from typing import TYPE_CHECKING, Any, Final, SupportsIndex, TypeVar, overload

import numpy as np

from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup
from rlightning_aio._core.group.api.facade import default_min_results, ensure_auto_reset
from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup
from rlightning_aio.batch.contents import all_agents, summed_rewards
from rlightning_aio.collecting.procedure import Procedure, run
from rlightning_aio.errors import EnvBusy, RLightningError
from rlightning_aio.evaluation.episodes import Episode, Evaluation, check_numbers
from rlightning_aio.evaluation.outcomes import (
    EndlessEpisodes,
    success_of,
)
from rlightning_aio.evaluation.queue import QueuePlay, QueueRules
from rlightning_aio.outcomes import is_bystanders
from rlightning_aio.policies.answers import answers_of
from rlightning_aio.policies.random_actions import RandomPolicy

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.attempts.spec import EpisodeSpec
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.evaluation.episode_video import EpisodeVideo
    from rlightning_aio.evaluation.records import EpisodeRecord, QueueEvaluation
    from rlightning_aio.evaluation.results_file import ResultsFile
    from rlightning_aio.outcomes import Outcome
    from rlightning_aio.types import EnvMeta

__all__ = ["evaluate"]

G = TypeVar("G", AsyncEnvGroup, SyncEnvGroup)

_LOSSES_IN_A_ROW: Final = 3
"""An env that loses this many episodes in a row is assumed to finish none."""


@overload
def evaluate(
    group: SyncEnvGroup,
    policy: Callable[[BatchedData], Any] | None,
    episodes: int,
    *,
    seed: int | None = None,
    min_results: int | None = None,
    played: Iterable[Episode] | None = None,
    on_episode: Callable[[Episode], None] | None = None,
) -> Evaluation: ...


@overload
def evaluate(
    group: AsyncEnvGroup,
    policy: Callable[[BatchedData], Any] | None,
    episodes: int,
    *,
    seed: int | None = None,
    min_results: int | None = None,
    played: Iterable[Episode] | None = None,
    on_episode: Callable[[Episode], None] | None = None,
) -> Coroutine[Any, Any, Evaluation]: ...


@overload
def evaluate(
    group: SyncEnvGroup,
    policy: Callable[[BatchedData], Any] | None,
    episodes: Iterable[EpisodeSpec],
    *,
    min_results: int | None = None,
    max_attempts: int | None = None,
    results: ResultsFile | None = None,
    video: EpisodeVideo | None = None,
    on_episode: Callable[[EpisodeRecord], None] | None = None,
) -> QueueEvaluation: ...


@overload
def evaluate(
    group: AsyncEnvGroup,
    policy: Callable[[BatchedData], Any] | None,
    episodes: Iterable[EpisodeSpec],
    *,
    min_results: int | None = None,
    max_attempts: int | None = None,
    results: ResultsFile | None = None,
    video: EpisodeVideo | None = None,
    on_episode: Callable[[EpisodeRecord], None] | None = None,
) -> Coroutine[Any, Any, QueueEvaluation]: ...


def evaluate(
    group: Any,
    policy: Callable[[BatchedData], Any] | None,
    episodes: int | Iterable[EpisodeSpec],
    *,
    seed: int | None = None,
    min_results: int | None = None,
    max_attempts: int | None = None,
    results: ResultsFile | None = None,
    video: EpisodeVideo | None = None,
    played: Iterable[Episode] | None = None,
    on_episode: Callable[[Any], None] | None = None,
) -> Any:
    """Play episodes with `policy`. Await it if the group is asynchronous.

    Envs are reset at their ends, and at the limits of an open `auto_reset`, or else at their own.

    Args:
        group: with nothing `pending` and without env_servers.
        policy: called with a batch of results (`BatchedData`). It returns actions, or columns by
            name with ``action``, or what `BatchedData.respond` returns, or a list of such; with an
            asynchronous group, it may be awaitable. None: random actions.
        episodes: a number for each env, and for each sub-environment; or a queue of episodes,
            each to be played once by any free env.
        seed: for a number of episodes: episode n of env k (of N, counting sub-environments) has the
            seed ``seed + n * N + k``; of sub-environments that reset themselves, only the first.
        min_results: results to wait for; None is half of the envs.
        max_attempts: for a queue: an episode that was lost this often has failed; None is 3.
        results: for a queue: the file to save episodes in; those that it has are not played again.
        video: for a queue: the episodes to film.
        played: for a number of episodes: those that were played before.
        on_episode: called with each episode as it ends.

    Of a number of episodes, one that is lost with its worker starts again with the same seed. Of a
    queue, one that is lost with its worker or by an exception waits again, for any env; an env
    whose worker is not replaced leaves the others to play.

    Raises:
        EnvBusy: an env has a request in flight, or a result that was not collected.
        ValueError: a number is below 1, an option is meant for the other kind of `episodes`, the
            group has an env_server, or `played` has duplicates or episodes of other envs. Of a
            queue: an episode is there twice, no entry of the group or more than one can play it, or
            an env has sub-environments.
        RLightningError: of a number of episodes: an env has ended its worker three times in a row.
        BadAction: the policy's actions don't fit; nothing was sent.
        EnvRaised, WorkerDied, EnvHung: as for `EnvGroup.collect_async`; for a queue, only if no env
            is left that could play an episode.
        OSError: nothing can be written into the folder of `video`.
    """
    _check(group, episodes, min_results, max_attempts)
    policy, min_results = policy or _random(group, seed), min_results or default_min_results(group)
    if isinstance(episodes, SupportsIndex):
        _refuse("a queue of episodes", max_attempts=max_attempts, results=results, video=video)
        play = _Play(group, policy, index(episodes), seed, min_results, on_episode)
        play.take_over(played or ())
    else:
        _refuse("a number of episodes", seed=seed, played=played)
        rules = QueueRules(min_results, max_attempts or 3, results, video, on_episode)
        play = QueuePlay(group, policy, episodes, rules)
    return run(_resetting(play, group), group)


def _resetting(play: _Play | QueuePlay, group: Any) -> Procedure[Any]:
    with ensure_auto_reset(group):
        return (yield from play.to_the_end())


def _random(group: Any, seed: int | None) -> RandomPolicy:
    return RandomPolicy({meta.env_id: meta.action_space for meta in group.metas}.get, seed)


def _refuse(form: str, **options: Any) -> None:
    """Raise an error if an option is given that is for another form of `episodes`."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{name} is for {form}; leave it out")


def _check(group: Any, episodes: Any, min_results: int | None, max_attempts: int | None) -> None:
    numbers = {"min_results": min_results, "max_attempts": max_attempts}
    if isinstance(episodes, SupportsIndex):
        numbers["episodes"] = index(episodes)
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, not {number!r}")
    for meta in group.metas:
        if meta.action_space is None:
            raise ValueError(
                f"{meta.env_id} is an env_server, whose clients come and go; evaluate a group "
                "without env_servers"
            )
    if pending := group.pending:
        raise EnvBusy(
            f"{pending[0]!r} has a request whose result was not collected; collect it, or close "
            "the group. A Collector leaves requests in flight after each rollout: to evaluate "
            "between rollouts, build a second group of the same entries"
        )


class _Play:
    """An evaluation in progress. Arrays have an element for each sub-environment of the group."""

    def __init__(
        self,
        group: Any,
        policy: Callable[[BatchedData], Any],
        episodes: int,
        seed: int | None,
        min_results: int | None,
        on_episode: Callable[[Episode], None] | None,
    ) -> None:
        self._group, self._policy = group, policy
        self._episodes, self._seed, self._min_results = episodes, seed, min_results
        metas: list[EnvMeta] = group.metas
        firsts = np.cumsum([0, *(meta.num_envs for meta in metas)]).tolist()
        self._first = {meta.env_id: first for meta, first in zip(metas, firsts, strict=False)}
        self._metas = {meta.env_id: meta for meta in metas}
        self._size: int = firsts[-1]
        self._count = np.zeros(self._size, np.int64)
        # Of the current episodes; `_open` is False between episodes.
        self._open = np.zeros(self._size, np.bool_)
        self._reward = np.zeros(self._size)
        self._length = np.zeros(self._size, np.int64)
        self._lost: set[str] = set()
        # The number of the episodes that a reset begins, until its result has come.
        self._begins: dict[str, int] = {}
        self._losses = Counter[str]()
        self._endless = EndlessEpisodes()
        # Results of different shapes don't stack.
        self._separate = len({(meta.num_envs, meta.agents) for meta in metas}) > 1
        self._found = Evaluation()
        self._on_episode = on_episode

    def take_over(self, played: Iterable[Episode]) -> None:
        """Add episodes that were played earlier."""
        played = list(played)
        check_numbers(played)
        for episode in played:
            meta = self._metas.get(episode.env_id)
            if meta is None or not 0 <= episode.sub_env < meta.num_envs:
                raise ValueError(f"{episode} was not played by an env of this group")
            self._found.episodes.append(episode)
            self._count[self._first[episode.env_id] + episode.sub_env] += 1

    # -- the loop -----------------------------------------------------------------

    def to_the_end(self) -> Procedure[Evaluation]:
        """Play the remaining episodes."""
        env_ids = [env_id for env_id in self._metas if self._left(env_id)]
        if not env_ids:
            return self._found
        batch: BatchedData
        seeds = self._next_seeds(env_ids)
        batch, _ = yield lambda: self._group.reset(seeds, env_ids=env_ids)
        pending = yield from self._continue(batch)
        while pending:
            batch, _ = yield lambda: self._group.collect_async(min_results=self._min_results)
            pending += (yield from self._continue(batch)) - len(batch)
        return self._found

    def _continue(self, batch: BatchedData) -> Procedure[int]:
        """Record results, and step or reset their envs. Return the number of requests."""
        for part in batch.by_entry().values() if self._separate else (batch,):
            self._record(part)
        resets: list[str] = []
        steps: list[int] = []
        for row, env_id in enumerate(batch.env_ids()):
            if not self._left(env_id):
                continue
            if self._needs_reset(env_id):
                resets.append(env_id)
            else:
                steps.append(row)
        if resets:
            self._group.reset_async(seed=self._next_seeds(resets), env_ids=resets)
        if steps:
            stepped = batch if len(steps) == len(batch) else batch.take(steps)
            answer = yield lambda: self._policy(stepped)
            for part in answers_of(stepped, answer, lambda: self._space_of(stepped)):
                self._group.step_async(part)
        return len(resets) + len(steps)

    def _space_of(self, batch: BatchedData) -> gym.Space[Any] | None:
        return self._metas[batch.env_ids()[0]].action_space

    def _places(self, env_id: str) -> slice:
        first = self._first[env_id]
        return slice(first, first + self._metas[env_id].num_envs)

    def _left(self, env_id: str) -> bool:
        return bool((self._count[self._places(env_id)] < self._episodes).any())

    def _needs_reset(self, env_id: str) -> bool:
        """Return True if an env has lost its episode, or is between episodes without autoreset."""
        resets_itself = self._metas[env_id].autoreset != "disabled"
        lost = env_id in self._lost
        self._lost.discard(env_id)
        return lost or not (resets_itself or self._open[self._places(env_id)].any())

    def _next_seeds(self, env_ids: list[str]) -> dict[str, int] | None:
        """Seeds of the next episodes of envs that are about to be reset.

        Sub-environments may have finished different numbers, because of a loss. The reset then
        begins the first that is missing, and others play one that isn't counted.
        """
        for env_id in env_ids:
            self._begins[env_id] = int(self._count[self._places(env_id)].min())
        if self._seed is None:
            return None
        return {
            env_id: self._seed + self._begins[env_id] * self._size + self._first[env_id]
            for env_id in env_ids
        }

    # -- results ------------------------------------------------------------------

    def _record(self, batch: BatchedData) -> None:
        """Add results to their episodes."""
        shape = batch.is_reset.shape
        places = batch.index.reshape(-1)
        begins = batch.is_reset.reshape(-1)
        if batch.restarted.any():
            self._note_losses(batch)
        done = all_agents(batch.done).reshape(-1)
        stepped = self._open[places] & ~begins
        rewards = np.where(stepped, summed_rewards(batch.reward).reshape(-1), 0.0)
        with np.errstate(over="ignore", invalid="ignore"):  # The return shows it.
            self._reward[places] += rewards
        self._length[places] += stepped
        self._endless.look(self._length[places].reshape(shape), batch.env_ids())
        ended = stepped & done
        if ended.any():
            self._note_ends(batch, ended.reshape(shape))
        self._open[places[ended]] = False
        again = self._begun_again(batch, done.reshape(shape)).reshape(-1)
        counted = self._counted(batch).reshape(-1)
        self._open[places[begins]] = counted[begins]
        self._open[places[again]] = True
        for begun in (places[begins], places[again]):
            self._reward[begun] = self._length[begun] = 0

    def _counted(self, batch: BatchedData) -> NDArray[np.bool_]:
        """Mask of the episodes that count if they begin; see `_next_seeds`."""
        found = np.ones(batch.is_reset.shape, np.bool_)
        for row, env_id in enumerate(batch.env_ids() if self._begins else ()):
            number = self._begins.pop(env_id, None)
            if number is not None:
                found[row] = self._count[batch.index[row]] == number
        return found

    def _begun_again(self, batch: BatchedData, done: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of episodes that are `done` and whose env has begun the next in the same step."""
        modes = [self._metas[env_id].autoreset for env_id in batch.env_ids()]
        same_step = np.array([mode == "same_step" for mode in modes], np.bool_)
        return (done.T & same_step).T

    def _note_ends(self, batch: BatchedData, ended: NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(ended.reshape(len(batch), -1).any(axis=1))
        infos = batch.take(rows.tolist()).info()
        env_ids = batch.env_ids()
        for row, info in zip(rows.tolist(), infos, strict=True):
            env_id = env_ids[row]
            for sub_env in np.flatnonzero(ended[row].reshape(-1)).tolist():
                place = self._first[env_id] + sub_env
                if self._count[place] < self._episodes:
                    self._note(env_id, sub_env, place, success_of(info, sub_env))
            self._losses[env_id] = 0

    def _note(self, env_id: str, sub_env: int, place: int, success: bool | None) -> None:
        episode = Episode(
            env_id,
            sub_env,
            number=int(self._count[place]),
            total_reward=float(self._reward[place]),
            length=int(self._length[place]),
            success=success,
        )
        self._count[place] += 1
        self._found.episodes.append(episode)
        if self._on_episode is not None:
            self._on_episode(episode)

    def _note_losses(self, batch: BatchedData) -> None:
        rows = np.flatnonzero(batch.restarted.reshape(len(batch), -1).any(axis=1))
        env_ids = batch.env_ids()
        infos = batch.take(rows.tolist()).info()
        for row, info in zip(rows.tolist(), infos, strict=True):
            env_id = env_ids[row]
            self._found.lost += int(self._open[self._places(env_id)].sum())
            self._lost.add(env_id)
            lost: Outcome = info["outcome"]
            if is_bystanders(lost):
                continue  # Another env of its worker is at fault, and reports so.
            self._losses[env_id] += 1
            if self._losses[env_id] == _LOSSES_IN_A_ROW:
                raise RLightningError(
                    f"env {env_id!r} has lost an episode with its worker {_LOSSES_IN_A_ROW} times "
                    f"in a row, and finishes none: {lost.cause}. Episodes start again with their "
                    "seed, so a crash that depends on it repeats: a list of EpisodeSpec gives such "
                    "an episode up, and plays the others"
                )
