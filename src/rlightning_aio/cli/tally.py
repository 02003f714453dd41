"""What a rollout has collected, counted by config entry.

Rule: a step is an action that an env has executed; resets, which arrive as results too,
are told apart and left out. A vectorised env's step counts once for each sub-environment.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.config import EnvConfig

__all__ = ["EntryFigures", "Tally"]

_LATENCY_BATCHES: Final = 4096
"""Batches whose step times are kept for the percentiles."""


@dataclass(frozen=True, slots=True)
class EntryFigures:
    """One line of the closing table; a figure is None where nothing was seen.

    Attributes:
        step_us: time in the env's own step, p50 and p99, in microseconds.
    """

    name: str
    envs: int
    steps: int
    steps_per_second: float
    episodes: int
    mean_return: float | None
    mean_length: float | None
    step_us: dict[str, float] | None


class Tally:
    """Counts results as they are collected.

    Args:
        configs: of the group, in order.
    """

    def __init__(self, configs: Sequence[EnvConfig]) -> None:
        self._configs = configs
        self._entry_of = {
            f"{config.name}-{index}": config.name
            for config in configs
            for index in range(config.num_workers)
        }
        self._sub_envs = {config.name: config.num_envs for config in configs}
        self._entry_of_slot = np.repeat(
            np.arange(len(configs)), [config.num_workers for config in configs]
        )
        self._counts: Counter[str] = Counter()
        self._resetting: set[str] = set()
        self._step_times: deque[tuple[NDArray[np.intp], NDArray[np.int64]]] = deque(
            maxlen=_LATENCY_BATCHES
        )
        self._began = self._ended = 0.0
        self.steps = 0

    @property
    def began(self) -> bool:
        """Whether there is anything to tell."""
        return self._began > 0

    @property
    def seconds(self) -> float:
        """From the first step sent to the last result counted."""
        return self._ended - self._began

    @property
    def steps_per_second(self) -> float:
        """Over the whole time."""
        return self.steps / self.seconds if self.seconds else 0.0

    def begin(self) -> None:
        """The first steps are about to be sent."""
        self._began = self._ended = time.monotonic()

    def add(self, batch: BatchedData, flags: Sequence[bool]) -> None:
        """Count what `collect_async` or `step` returned inside `auto_reset`."""
        self._ended = time.monotonic()
        env_ids, entries = batch.env_ids(), self._entry_of
        resets = self._resetting.intersection(env_ids) if self._resetting else ()
        counted = Counter(entries[id_] for id_ in batch.ids())
        for env_id in resets:
            counted[entries[env_id]] -= 1
        self._counts += counted
        self.steps += sum(self._sub_envs[name] * count for name, count in counted.items())
        self._resetting.difference_update(resets)
        ended = batch.ended
        if ended.any() or any(flags):
            self._resetting.update(env_ids[k] for k in np.flatnonzero(ended | flags).tolist())
        for part in batch.parts:
            self._step_times.append((part.slots, part.busy_ns))

    def by_entry(self, env_stats: Mapping[str, Mapping[str, Any]]) -> list[EntryFigures]:
        """One line for each entry, with the episodes of `EnvGroup.get_env_stats`."""
        return [self._figures(index, env_stats) for index in range(len(self._configs))]

    def _figures(self, index: int, env_stats: Mapping[str, Mapping[str, Any]]) -> EntryFigures:
        config = self._configs[index]
        own = [env_stats[id_] for id_, name in self._entry_of.items() if name == config.name]
        episodes = sum(stats["episodes"] for stats in own)
        steps = self._counts[config.name] * config.num_envs
        return EntryFigures(
            name=config.name,
            envs=config.num_workers * config.num_envs,
            steps=steps,
            steps_per_second=steps / self.seconds if self.seconds else 0.0,
            episodes=episodes,
            mean_return=_mean(own, "mean_return", episodes),
            mean_length=_mean(own, "mean_length", episodes),
            step_us=self._step_us(index),
        )

    def _step_us(self, index: int) -> dict[str, float] | None:
        times = [busy[self._entry_of_slot[slots] == index] for slots, busy in self._step_times]
        taken = np.concatenate(times) if times else np.empty(0)
        if not len(taken):
            return None
        p50, p99 = np.percentile(taken, [50, 99]) / 1e3
        return {"p50": float(p50), "p99": float(p99)}

    def mean_step_us(self) -> float | None:
        """Time in an env's own step, mean over all entries, in microseconds."""
        if not self._step_times:
            return None
        return float(np.concatenate([busy for _, busy in self._step_times]).mean()) / 1e3


def _mean(stats: Sequence[Mapping[str, Any]], key: str, episodes: int) -> float | None:
    """Mean over all episodes of all envs."""
    if not episodes:
        return None
    return float(sum(s[key] * s["episodes"] for s in stats if s["episodes"]) / episodes)
