"""`evaluate`: equally many episodes of each env, first come, first served.

Rule: which episodes are played is decided before the first step, whatever their length. An env that
resets itself is stepped until each of its sub-environments has played its number; episodes beyond
that are ignored.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast, overload

import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.collecting.procedure import Procedure, run
from rlightning_aio.errors import RLightningError
from rlightning_aio.evaluation.episodes import Episode, Evaluation
from rlightning_aio.group.aio import EnvGroup as AsyncEnvGroup
from rlightning_aio.group.sync import EnvGroup as SyncEnvGroup

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable

    from numpy.typing import NDArray

    from rlightning_aio.types import EnvMeta

__all__ = ["evaluate"]

G = TypeVar("G", AsyncEnvGroup, SyncEnvGroup)

_LOSSES_IN_A_ROW: Final = 3
"""An env whose workers end again and again plays no episode to its end."""
_VERDICTS: Final = ("success", "is_success")


@overload
def evaluate(
    group: SyncEnvGroup,
    policy: Callable[[BatchedData], Any],
    episodes: int,
    *,
    seed: int | None = None,
    min_batch: int = 1,
    played: Iterable[Episode] = (),
    on_episode: Callable[[Episode], None] | None = None,
) -> Evaluation: ...


@overload
def evaluate(
    group: AsyncEnvGroup,
    policy: Callable[[BatchedData], Any],
    episodes: int,
    *,
    seed: int | None = None,
    min_batch: int = 1,
    played: Iterable[Episode] = (),
    on_episode: Callable[[Episode], None] | None = None,
) -> Coroutine[Any, Any, Evaluation]: ...


def evaluate(
    group: Any,
    policy: Callable[[BatchedData], Any],
    episodes: int,
    *,
    seed: int | None = None,
    min_batch: int = 1,
    played: Iterable[Episode] = (),
    on_episode: Callable[[Episode], None] | None = None,
) -> Any:
    """Play `episodes` episodes of each env with `policy`. Await it if the group is asynchronous.

    Use it inside ``with group.auto_reset():``, whose step limits hold.

    Args:
        group: initialised, with no request outstanding, of envs of its own (no env_server).
        policy: called with a batch of results (`BatchedData`); returns actions, ``[n, *action]``
            with one row for each result, a batch made by its `respond`, or a list of such
            batches, which together answer it. It may be a coroutine function, if the group is
            asynchronous.
        episodes: of each env, and of each sub-environment.
        seed: episode n of env k (counting sub-environments, N of them) is reset with the seed
            ``seed + n * N + k``, so what it shows depends on nothing that was played before. An
            env whose sub-environments reset themselves has seeds for its first episodes alone.
        min_batch: results to wait for before the policy is called, or as many as are pending.
        played: episodes of an evaluation that was interrupted; they are not played again.
        on_episode: called with each episode as it ends.

    An episode that is lost with its worker starts again, with its seed.

    Raises:
        RuntimeError: the group has no `auto_reset` context open.
        ValueError: a number isn't above 0, the group has an env_server, or `played` holds
            episodes of other envs.
        RLightningError: an env has lost an episode with its worker three times in a row.
        BadAction: the policy's actions don't fit; nothing was sent.
        EnvRaised, WorkerDied, EnvHung: as of `EnvGroup.collect_async`.
    """
    for name, number in (("episodes", episodes), ("min_batch", min_batch)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, not {number!r}")
    if not group.resets_by_itself:
        raise RuntimeError(
            "envs whose episode is over must be reset: evaluate inside `with group.auto_reset():`"
        )
    play = _Play(group, policy, episodes, seed, min_batch)
    play.take_over(played)
    play.on_episode = on_episode
    return run(play.to_the_end(), group)


class _Play:
    """An evaluation under way. Arrays have a place for each sub-environment of the group."""

    def __init__(
        self,
        group: Any,
        policy: Callable[[BatchedData], Any],
        episodes: int,
        seed: int | None,
        min_batch: int,
    ) -> None:
        self._group, self._policy = group, policy
        self._episodes, self._seed, self._min_batch = episodes, seed, min_batch
        metas: list[EnvMeta] = group.metas
        for meta in metas:
            if meta.action_space is None:
                raise ValueError(
                    f"{meta.env_id} is an env_server, whose clients come and go; evaluate envs "
                    "that the group has itself"
                )
        firsts = np.cumsum([0, *(meta.num_envs for meta in metas)]).tolist()
        self._first = {meta.env_id: first for meta, first in zip(metas, firsts, strict=False)}
        self._metas = {meta.env_id: meta for meta in metas}
        self._size: int = firsts[-1]
        self._count = np.zeros(self._size, np.int64)
        # Of the episode that each is in, if it is in one.
        self._open = np.zeros(self._size, np.bool_)
        self._reward = np.zeros(self._size)
        self._length = np.zeros(self._size, np.int64)
        self._lost: set[str] = set()
        self._losses = Counter[str]()
        # Whose shapes differ don't stack.
        self._separate = len({(meta.num_envs, meta.agents) for meta in metas}) > 1
        self._found = Evaluation()
        self.on_episode: Callable[[Episode], None] | None = None

    def take_over(self, played: Iterable[Episode]) -> None:
        """Count episodes that were played before."""
        for episode in played:
            meta = self._metas.get(episode.env_id)
            if meta is None or not 0 <= episode.sub_env < meta.num_envs:
                raise ValueError(f"{episode} was not played by an env of this group")
            self._found.episodes.append(episode)
            self._count[self._first[episode.env_id] + episode.sub_env] += 1

    # -- the loop -----------------------------------------------------------------

    def to_the_end(self) -> Procedure[Evaluation]:
        """Play all that is left."""
        env_ids = [env_id for env_id in self._metas if self._left(env_id)]
        if not env_ids:
            return self._found
        seeds = self._seeds(env_ids)
        batch: BatchedData
        batch, _ = yield lambda: self._group.reset(
            None if seeds is None else list(seeds.values()), env_ids=env_ids
        )
        pending = yield from self._go_on(batch)
        while pending:
            # It waits for no more than are pending.
            batch, _ = yield lambda: self._group.collect_async(min_results=self._min_batch)
            pending += (yield from self._go_on(batch)) - len(batch)
        return self._found

    def _go_on(self, batch: BatchedData) -> Procedure[int]:
        """Take results in, and have their envs go on; how many do."""
        for part in batch.by_name().values() if self._separate else (batch,):
            self._take_in(part)
        resets: list[str] = []
        steps: list[int] = []
        for row, env_id in enumerate(batch.env_ids()):
            if not self._left(env_id):
                continue
            if self._is_to_reset(env_id):
                resets.append(env_id)
            else:
                steps.append(row)
        if resets:
            self._group.reset_async(seed=self._seeds(resets), env_ids=resets)
        if steps:
            going = batch if len(steps) == len(batch) else batch.take(steps)
            answer = yield lambda: self._policy(going)
            for responses in _responses(going, answer):
                self._group.step_async(responses)
        return len(resets) + len(steps)

    def _places(self, env_id: str) -> slice:
        first = self._first[env_id]
        return slice(first, first + self._metas[env_id].num_envs)

    def _left(self, env_id: str) -> bool:
        return bool((self._count[self._places(env_id)] < self._episodes).any())

    def _is_to_reset(self, env_id: str) -> bool:
        """Whether an env is in no episode, and doesn't begin one by itself; or has lost its own."""
        resets_itself = self._metas[env_id].autoreset != "disabled"
        lost = env_id in self._lost
        self._lost.discard(env_id)
        return lost or not (resets_itself or self._open[self._places(env_id)].any())

    def _seeds(self, env_ids: list[str]) -> dict[str, int] | None:
        """Seeds of the next episodes of envs."""
        if self._seed is None:
            return None
        return {
            env_id: self._seed
            + int(self._count[self._places(env_id)].max()) * self._size
            + self._first[env_id]
            for env_id in env_ids
        }

    # -- results ------------------------------------------------------------------

    def _take_in(self, batch: BatchedData) -> None:
        """Add results to the episodes that they belong to."""
        shape = batch.is_reset.shape
        places = batch.index.reshape(-1)
        begins = batch.is_reset.reshape(-1)
        if batch.restarted.any():
            self._note_losses(batch)
        done = _of_all(batch.done).reshape(-1)
        stepped = self._open[places] & ~begins
        rewards = np.where(stepped, _summed(batch.reward).reshape(-1), 0.0)
        self._reward[places] += rewards
        self._length[places] += stepped
        ended = stepped & done
        if ended.any():
            self._note_ends(batch, ended.reshape(shape))
        self._open[places[ended]] = False
        again = self._begun_again(batch, ended.reshape(shape)).reshape(-1)
        for begun in (places[begins], places[again]):
            self._open[begun] = True
            self._reward[begun] = self._length[begun] = 0

    def _begun_again(self, batch: BatchedData, ended: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where the next episode began in the step that has ended one."""
        modes = [self._metas[env_id].autoreset for env_id in batch.env_ids()]
        at_once = np.array([mode == "same_step" for mode in modes], np.bool_)
        return (ended.T & at_once).T

    def _note_ends(self, batch: BatchedData, ended: NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(ended.reshape(len(batch), -1).any(axis=1))
        infos = batch.take(rows.tolist()).info()
        env_ids = batch.env_ids()
        for row, info in zip(rows.tolist(), infos, strict=True):
            env_id = env_ids[row]
            for sub_env in np.flatnonzero(ended[row].reshape(-1)).tolist():
                place = self._first[env_id] + sub_env
                if self._count[place] < self._episodes:
                    self._note(env_id, sub_env, place, _verdict(info, sub_env))
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
        if self.on_episode is not None:
            self.on_episode(episode)

    def _note_losses(self, batch: BatchedData) -> None:
        rows = np.flatnonzero(batch.restarted.reshape(len(batch), -1).any(axis=1))
        env_ids = batch.env_ids()
        infos = batch.take(rows.tolist()).info()
        for row, info in zip(rows.tolist(), infos, strict=True):
            env_id = env_ids[row]
            self._found.lost += int(self._open[self._places(env_id)].sum())
            self._losses[env_id] += 1
            # Whatever it goes on with is no episode of ours.
            self._lost.add(env_id)
            if self._losses[env_id] == _LOSSES_IN_A_ROW:
                cause = info.get("worker_restarted", "its worker ended")
                raise RLightningError(
                    f"env {env_id!r} has lost an episode with its worker {_LOSSES_IN_A_ROW} times "
                    f"in a row, and finishes none: {cause}"
                )


def _responses(batch: BatchedData, answer: Any) -> list[BatchedData]:
    """The batches of responses that a policy's answer stands for."""
    if isinstance(answer, BatchedData):
        return [answer]
    if isinstance(answer, list):
        listed = cast("list[Any]", answer)
        if listed and all(isinstance(one, BatchedData) for one in listed):
            return listed
    return [batch.respond(action=answer)]


def _summed(reward: Any) -> NDArray[np.float64]:
    """Rewards of several agents together."""
    if isinstance(reward, dict):
        reward = np.sum(list(cast("dict[str, Any]", reward).values()), axis=0)
    return np.asarray(reward, np.float64)


def _of_all(done: Any) -> NDArray[np.bool_]:
    """Whether an episode is over for all of its agents."""
    if isinstance(done, dict):
        return np.logical_and.reduce(list(cast("dict[str, Any]", done).values()))
    return done


def _verdict(info: dict[str, Any], sub_env: int) -> bool | None:
    """What the info of an episode's end says of it; of an env that has begun the next one, what
    that of its last step says.
    """
    final: Any = info.get("final_info")
    places: list[Any] = [final, info] if isinstance(final, dict) else [info]
    for found in places:
        for key in _VERDICTS:
            given, known = found.get(key), found.get(f"_{key}")
            if given is not None and (known is None or known[sub_env]):
                # A tensor may lie on another device.
                array = np.asarray(given.tolist() if hasattr(given, "tolist") else given)
                return bool(array.reshape(-1)[sub_env if array.size > 1 else 0])
    return None
