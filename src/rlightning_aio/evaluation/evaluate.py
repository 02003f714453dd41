"""`evaluate`: a number of episodes of each env, or a queue of episodes, played with a policy."""

from __future__ import annotations

from contextlib import closing
from operator import index
from typing import TYPE_CHECKING, Any, SupportsIndex, TypeAlias, overload

from rlightning_aio._core.group.api.facade import (
    default_min_results,
    ensure_auto_reset,
    stop_hardware,
)
from rlightning_aio.attempts.queue import AttemptQueue
from rlightning_aio.attempts.rules import Rules
from rlightning_aio.attempts.spec import EpisodeSpec
from rlightning_aio.collecting.procedure import Procedure, run
from rlightning_aio.errors import EnvBusy
from rlightning_aio.evaluation.films import Films
from rlightning_aio.evaluation.playing import PolicyPlay
from rlightning_aio.policies.answers import check_policies, policies_of
from rlightning_aio.policies.predicting import Model, PredictPolicy
from rlightning_aio.policies.random_actions import RandomPolicy

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Coroutine, Iterable, Mapping

    from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup
    from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup
    from rlightning_aio.attempts.file import ResultsFile
    from rlightning_aio.attempts.queue import TaskInPlay
    from rlightning_aio.attempts.records import Attempt
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.evaluation.evaluation import Evaluation

Function: TypeAlias = "Callable[[BatchedData], Any]"
Policy: TypeAlias = "Callable[[BatchedData], Any] | Model | None"


@overload
def evaluate(
    group: SyncEnvGroup,
    policy: Policy | Mapping[str, Policy],
    episodes: int | Iterable[EpisodeSpec],
    *,
    seed: int | None = None,
    min_results: int | None = None,
    retries: int = 2,
    results: ResultsFile | None = None,
    video: str | os.PathLike[str] | None = None,
    on_episode: Callable[[Attempt], None] | None = None,
) -> Evaluation: ...


@overload
def evaluate(
    group: AsyncEnvGroup,
    policy: Policy | Mapping[str, Policy],
    episodes: int | Iterable[EpisodeSpec],
    *,
    seed: int | None = None,
    min_results: int | None = None,
    retries: int = 2,
    results: ResultsFile | None = None,
    video: str | os.PathLike[str] | None = None,
    on_episode: Callable[[Attempt], None] | None = None,
) -> Coroutine[Any, Any, Evaluation]: ...


def evaluate(
    group: Any,
    policy: Policy | Mapping[str, Policy],
    episodes: int | Iterable[EpisodeSpec],
    *,
    seed: int | None = None,
    min_results: int | None = None,
    retries: int = 2,
    results: ResultsFile | None = None,
    video: str | os.PathLike[str] | None = None,
    on_episode: Callable[[Attempt], None] | None = None,
) -> Any:
    """Play episodes with `policy`. Await it if the group is asynchronous.

    Envs are reset at their ends, and at the limits of an open `auto_reset`, or else at their own.

    Args:
        group: with nothing `pending`.
        policy: called with a batch of results (`BatchedData`). It returns actions, or columns by
            name with ``action``, or what `BatchedData.respond` returns, or a list of such; with an
            asynchronous group, it may be awaitable. Or a model with the `predict` of
            Stable-Baselines3, for its most probable actions. None: random actions. Or a dict with
            one of these for each config entry, for entries of different spaces.
        episodes: a number for each env, and for each sub-environment; or a queue of episodes,
            each to be played once by any free env.
        seed: for a number of episodes: episode n of env k (of N, counting sub-environments) has the
            seed ``seed + n * N + k``; of sub-environments that reset themselves, only the first.
        min_results: results to wait for; None is half of the envs.
        retries: how often an episode is played again that was lost with its worker or by an
            exception, unless policy or caller alone are to blame: with its seed, and by any env
            that may play it; not counted if another env of the worker is at fault. After that it
            has failed. After a loss, what moves something real plays no more: only you reset it.
        results: the file to save episodes in; those that it has are not played again. One file for
            each `seed`, since episodes without a seed are only known by their number.
        video: folder for films of the first episode of each task, which is asked for a frame by
            `render` after each step: ``<entry>-<task>-seed-<seed>.mp4``. The folder is created if
            missing; options of an episode add a number to the name, an episode for one env its env
            and number.
        on_episode: called with each episode: first with those in the file, then as others end.

    Raises:
        EnvBusy: an env has a request in flight, or a result that was not collected.
        ValueError: a number is out of its range, the spaces of an env_server are not known yet, an
            entry has no policy, an episode is in the queue twice, no entry of the group or more
            than one can play it, a queue has a `seed`, a queue or `video` is given for an env with
            sub-environments, or an env to be filmed has not the ``render_mode`` ``rgb_array``.
        BadAction: the policy's actions don't fit; nothing was sent.
        WorkerDied, EnvHung: no env is left that could play an episode.
        ConfigError: `results` can't be written.
        OSError: nothing can be written into the folder `video`.
        ImportError: `video` is given, and imageio-ffmpeg isn't installed.
    """
    number = index(episodes) if isinstance(episodes, SupportsIndex) else None
    _check(group, min_results, number, films=video is not None)
    films = Films(group, video)
    queue = AttemptQueue(group, Rules(retries=retries), results)
    least, policies = min_results or default_min_results(group), _by_entry(policy, group, seed)
    play = PolicyPlay(group, policies, queue, films, least, on_episode)
    play.note_known(_filled(group, queue, episodes, seed))
    return run(_resetting(play, group), group)


def _filled(
    group: Any, queue: AttemptQueue, episodes: int | Iterable[EpisodeSpec], seed: int | None
) -> list[TaskInPlay]:
    if isinstance(episodes, SupportsIndex):
        return _each(group, queue, index(episodes), seed)
    if seed is not None:
        raise ValueError("seed is for a number of episodes; those of a queue have their own")
    tasks = [queue.add(spec) for spec in episodes]
    _check_distinct(tasks)
    return tasks


def _each(group: Any, queue: AttemptQueue, episodes: int, seed: int | None) -> list[TaskInPlay]:
    """Queue a number of episodes of each env and sub-environment."""
    count = sum(meta.num_envs for meta in group.metas)
    tasks: list[TaskInPlay] = []
    first = 0
    for meta in group.metas:
        resets_itself = meta.autoreset != "disabled"
        for number in range(episodes):
            is_seeded = seed is not None and not (resets_itself and number)
            for sub_env in range(meta.num_envs):
                own = (seed or 0) + number * count + first + sub_env if is_seeded else None
                spec = EpisodeSpec("", own, env_id=meta.env_id)
                tasks.append(queue.pin(spec, number, sub_env))
        first += meta.num_envs
    return tasks


def _resetting(play: PolicyPlay, group: Any) -> Procedure[Evaluation]:
    with ensure_auto_reset(group), closing(play):
        try:
            return (yield from play.to_the_end())
        except GeneratorExit:  # It is abandoned.
            raise
        except BaseException:  # Ctrl-C and a cancellation, too.
            stop_hardware(group)
            yield from play.abandon()
            raise


def _by_entry(policy: Any, group: Any, seed: int | None) -> dict[str, Function]:
    """Return policies as functions of a batch, by entry; one for all envs has the name ``""``."""
    given = policies_of(policy)
    check_policies((worker["entry"] for worker in group.get_workers()), given)
    return {name: _called(one, group, seed) for name, one in given.items()}


def _called(policy: Policy, group: Any, seed: int | None) -> Function:
    if policy is None:
        return RandomPolicy({meta.env_id: meta.action_space for meta in group.metas}.get, seed)
    return policy if callable(policy) else PredictPolicy(policy)


def _check(group: Any, min_results: int | None, episodes: int | None, *, films: bool) -> None:
    for name, number in (("min_results", min_results), ("episodes", episodes)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, not {number!r}")
    for meta in group.metas:
        if meta.action_space is None:
            raise ValueError(
                f"no client has dialled in for {meta.env_id} yet, so its spaces are not known: "
                "reset() the group before, which waits for clients"
            )
    if pending := group.pending:
        raise EnvBusy(
            f"{pending[0]!r} has a request whose result was not collected; collect it, or drain() "
            "the group. A Collector leaves requests in flight after each rollout: to evaluate "
            "between rollouts, build a second group of the same entries"
        )
    for meta in group.metas:
        if (films or episodes is None) and meta.num_envs > 1:
            raise ValueError(
                f"{meta.env_id} has {meta.num_envs} sub-environments, but an env plays or films "
                "one episode of a queue at a time: num_envs: 1, and num_workers for the number of "
                "envs"
            )


def _check_distinct(tasks: list[TaskInPlay]) -> None:
    seen = set[Any]()
    for task in tasks:
        if task.spec.key in seen:
            raise ValueError(f"each episode is played once, but the queue has {task.spec} twice")
        seen.add(task.spec.key)
