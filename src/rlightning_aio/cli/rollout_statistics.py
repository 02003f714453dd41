"""Statistics of a rollout, by config entry.

Rule: a step is an action that an env has executed. Resets, which arrive as results, too, are left
out. A vectorised env's step counts once for each sub-environment. Counting works on whole columns:
nothing is done for each result, but for those that report a loss.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.batch.data import parts_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.batch.columns import EnvNames, ResultColumns
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.types import EnvMeta

__all__ = ["Course", "EntryFigures", "RolloutStatistics"]

_NOTHING: Final = np.empty(0, np.int64)
_COURSE_SECONDS: Final = 0.25
_COURSE_EPISODES: Final = 50_000
"""Number of episodes in a plot; of more, the last are kept."""
_LATENCY_BATCHES: Final = 4096
"""Number of batches whose step times are kept for percentiles."""


@dataclass(frozen=True, slots=True)
class EntryFigures:
    """A line of the final table; a figure without observations is None.

    Attributes:
        restarts: number of workers that were replaced.
        lost_steps: steps whose results were lost with a worker or client.
        losses: number of results that report a loss, by its cause.
        step_us: time in the env's own step in microseconds, p50 and p99.
    """

    name: str
    envs: int
    steps: int
    steps_per_second: float
    episodes: int
    mean_return: float | None
    mean_length: float | None
    restarts: int
    lost_steps: int
    losses: dict[str, int]
    step_us: dict[str, float] | None


class RolloutStatistics:
    """Counts results as they are collected.

    Args:
        configs: the group's entries, in order.
        keep_course: record `courses`.
    """

    def __init__(self, configs: Sequence[EnvConfig], *, keep_course: bool = False) -> None:
        self._configs = configs
        self._courses = {config.name: Course(config.name) for config in configs}
        self._keep_course = keep_course
        self._entries = {
            f"{config.name}-{index}": config.name
            for config in configs
            for index in range(config.num_workers)
        }
        self._meta_of: Callable[[str], EnvMeta] | None = None
        self._sub_envs: dict[str, int] = {}
        self._names: EnvNames | None = None
        # By slot: steps so far, and whether the next request is a reset.
        self._counts = _NOTHING
        self._over = np.empty(0, np.bool_)
        self._lost_steps, self._restarts = Counter[str](), Counter[str]()
        self._losses: dict[str, Counter[str]] = {}
        self._step_times: deque[_StepTimes] = deque(maxlen=_LATENCY_BATCHES)
        self._began = self._ended = 0.0
        self.steps = 0

    @property
    def seconds(self) -> float:
        """Return the seconds from the first step sent to the last result counted."""
        return self._ended - self._began

    @property
    def steps_per_second(self) -> float:
        """Return the mean rate over the whole time."""
        return self.steps / self.seconds if self.seconds else 0.0

    def end(self, now: float) -> None:
        """Record that no further result will come."""
        self._ended = now

    def elapsed(self, now: float) -> float:
        """Return the seconds since the first step was sent, or 0 before it."""
        return now - self._began if self._began else 0.0

    def idle(self, now: float) -> float:
        """Return the seconds since the last result, or since the first step was sent."""
        return now - self._ended if self._began else 0.0

    def courses(self) -> list[Course]:
        """Return the course of each entry; empty unless it was recorded."""
        for course in self._courses.values():
            course.end(self.seconds)
        return list(self._courses.values())

    def begin(self, meta_of: Callable[[str], EnvMeta]) -> None:
        """Record that the first steps are about to be sent.

        Args:
            meta_of: a function that returns the metadata for an env id; called at the env's
                first result.
        """
        self._meta_of = meta_of
        self._began = self._ended = time.monotonic()

    def add(self, batch: BatchedData) -> None:
        """Count the results of a `collect_async` or `step`."""
        self._ended = time.monotonic()
        for part in parts_of(batch):
            if part.names is not self._names:
                self._meet(part.names)
            stepped = ~part.is_reset.reshape(len(part), -1)
            counts = stepped.sum(axis=1)
            self._counts[part.slots] += counts
            self.steps += int(counts.sum())
            if part.restarted is not None:
                self._note_losses(part, stepped.shape[1])
            self._over[part.slots] = part.over
            self._step_times.append(_StepTimes(part.names, part.slots, part.busy_ns))
            if self._keep_course:
                self._note_course(part, stepped)

    def _note_course(self, part: ResultColumns, stepped: NDArray[np.bool_]) -> None:
        """Add results of one entry to its course."""
        rows = len(part)
        names = np.array(part.names.names(part.slots))
        ended = np.zeros((rows, 1), np.bool_)
        if part.episode_return is not None and part.episode_length is not None:
            ended = (part.done & (part.episode_length > 0)).reshape(rows, -1)
        for name in dict.fromkeys(names.tolist()):
            mine = names == name
            course = self._courses[name]
            course.add(int(stepped[mine].sum()), self.seconds)
            if part.episode_return is not None and ended[mine].any():
                returns = part.episode_return.reshape(rows, -1)[mine][ended[mine]]
                course.returns += [(course.steps, value) for value in returns.tolist()]

    def _note_losses(self, part: ResultColumns, sub_envs: int) -> None:
        """Count the results that report a loss, and the steps in flight that they answer."""
        assert part.restarted is not None
        for row in np.flatnonzero(part.restarted).tolist():
            info, slot = part.reported_info_of(row), part.slots[row : row + 1]
            (entry,) = part.names.names(slot)
            self._lost_steps[entry] += int(not self._over[slot]) * sub_envs
            cause = info.get("worker_restarted", info.get("client_lost", "unknown"))
            self._losses.setdefault(entry, Counter())[cause] += 1

    def _meet(self, names: EnvNames) -> None:
        """Register the envs of a group, with clients that have joined since."""
        if self._names is None:
            self._counts = np.zeros(len(names.env_ids), np.int64)
            self._over = np.zeros(len(names.env_ids), np.bool_)
        self._names = names
        assert self._meta_of is not None
        for env_id in names.env_ids:
            if env_id and env_id not in self._sub_envs:
                self._sub_envs[env_id] = self._meta_of(env_id).num_envs

    def _entry(self, env_id: str) -> str:
        """Return the env's config entry; for a client (``<server id>/<name>``), its server's."""
        if env_id in self._entries:
            return self._entries[env_id]
        return next(name for id_, name in self._entries.items() if env_id.startswith(f"{id_}/"))

    def note_workers(self, workers: Iterable[Mapping[str, Any]]) -> None:
        """Record the restarts so far, as `EnvGroup.get_workers` describes them."""
        self._restarts.clear()
        for worker in workers:
            self._restarts[worker["entry"]] += worker["restarts"]

    def by_entry(self, env_stats: Mapping[str, Mapping[str, Any]]) -> list[EntryFigures]:
        """Return a line for each entry, with the episodes of `EnvGroup.get_env_stats`."""
        steps, episodes = Counter[str](), dict[str, list[Mapping[str, Any]]]()
        if self._names is not None:
            counts = np.bincount(self._names.entries, self._counts).astype(np.int64).tolist()
            steps.update(dict(zip(self._names.entry_names, counts, strict=True)))
        for env_id, stats in env_stats.items():
            episodes.setdefault(self._entry(env_id), []).append(stats)
        return [
            self._figures(config, steps[config.name], episodes.get(config.name, []))
            for config in self._configs
        ]

    def _figures(
        self, config: EnvConfig, steps: int, stats: Sequence[Mapping[str, Any]]
    ) -> EntryFigures:
        episodes = sum(own["episodes"] for own in stats)
        return EntryFigures(
            name=config.name,
            envs=self._num_envs(config),
            steps=steps,
            steps_per_second=steps / self.seconds if self.seconds else 0.0,
            episodes=episodes,
            mean_return=_mean(stats, "mean_return", episodes),
            mean_length=_mean(stats, "mean_length", episodes),
            restarts=self._restarts[config.name],
            lost_steps=self._lost_steps[config.name],
            losses=dict(self._losses.get(config.name, {})),
            step_us=self._step_us(config.name),
        )

    def _num_envs(self, config: EnvConfig) -> int:
        """Return the number of sub-environments of an entry; for a server, of its known clients."""
        if config.backend != "env_server":
            return config.num_workers * config.num_envs
        return sum(n for id_, n in self._sub_envs.items() if self._entry(id_) == config.name)

    def _step_us(self, entry: str) -> dict[str, float] | None:
        taken = np.concatenate([times.of(entry) for times in self._step_times] or [_NOTHING])
        if not len(taken):
            return None
        p50, p99 = np.percentile(taken, [50, 99]) / 1e3
        return {"p50": float(p50), "p99": float(p99)}

    def mean_step_us(self) -> float | None:
        """Return the mean time of an env's own step over all entries, in microseconds."""
        if not self._step_times:
            return None
        return float(np.concatenate([times.busy_ns for times in self._step_times]).mean()) / 1e3


@dataclass(frozen=True, slots=True)
class _StepTimes:
    """Step times of one batch."""

    names: EnvNames
    slots: NDArray[np.intp]
    busy_ns: NDArray[np.int64]

    def of(self, entry: str) -> NDArray[np.int64]:
        """Return the step times of an entry's envs."""
        mine = [name == entry for name in self.names.names(self.slots)]
        return self.busy_ns[mine]


def _mean(stats: Sequence[Mapping[str, Any]], key: str, episodes: int) -> float | None:
    """Return the mean over all episodes of all envs."""
    if not episodes:
        return None
    return float(sum(s[key] * s["episodes"] for s in stats if s["episodes"]) / episodes)


@dataclass
class Course:
    """The course of a rollout of one entry.

    Attributes:
        steps: number of steps so far.
        rates: pairs of the seconds since the start and the steps per second of the last interval.
        returns: pairs of the entry's steps at the end of an episode and its return.
    """

    name: str
    steps: int = 0
    rates: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    returns: deque[tuple[int, float]] = field(
        default_factory=lambda: deque[tuple[int, float]](maxlen=_COURSE_EPISODES)
    )
    _since: tuple[float, int] = (0.0, 0)

    def add(self, steps: int, seconds: float) -> None:
        """Add steps that arrived at a time since the start."""
        self.steps += steps
        if seconds - self._since[0] >= _COURSE_SECONDS:
            self.end(seconds)

    def end(self, seconds: float) -> None:
        """Close the present interval."""
        then, before = self._since
        if seconds > then:
            self.rates.append((seconds, (self.steps - before) / (seconds - then)))
            self._since = seconds, self.steps
