"""Counters of RLightning's group: steps per episode and steps per second."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["EnvStepCounter", "ThroughputTracker"]


class EnvStepCounter:
    """Steps of each env's episode: -1 before the first reset, 0 after it.

    Args:
        env_ids: of all envs.
        max_steps_list: the limit of each.
    """

    def __init__(self, env_ids: Sequence[str], max_steps_list: Sequence[int]) -> None:
        if not isinstance(max_steps_list, list) or len(max_steps_list) != len(env_ids):
            raise ValueError("max_steps_list must be a list with one limit for each env")
        self._limits = dict(zip(env_ids, max_steps_list, strict=True))
        self._steps = dict.fromkeys(env_ids, -1)

    def reset(self, env_id: str) -> None:
        """Set an env's count to -1; the result of its reset then counts it up to 0."""
        self._steps[env_id] = -1

    def reset_all(self) -> None:
        """Set every env's count to -1."""
        self._steps = dict.fromkeys(self._steps, -1)

    def step(self, env_id: str) -> None:
        """Count one result of an env.

        Raises:
            ValueError: the env has reached its limit already.
        """
        if self.is_reached_max_steps(env_id):
            raise ValueError(
                f"env {env_id} has reached its limit of {self._limits[env_id]} steps; reset it"
            )
        self._steps[env_id] += 1

    def step_all(self) -> None:
        """Count one result of every env."""
        for env_id in self._steps:
            self.step(env_id)

    def get_steps(self, env_id: str) -> int:
        """Return the count of an env."""
        return self._steps[env_id]

    def __getitem__(self, env_id: str) -> int:
        return self._steps[env_id]

    def get_max_steps(self, env_id: str) -> int:
        """Return the limit of an env."""
        return self._limits[env_id]

    def is_reached_max_steps(self, env_id: str) -> bool:
        """Return True if an env has reached its limit."""
        return self._steps[env_id] == self._limits[env_id]

    def get_truncations(self, env_ids: Sequence[str]) -> list[bool]:
        """Return `is_reached_max_steps` of each env."""
        return [self.is_reached_max_steps(env_id) for env_id in env_ids]


class ThroughputTracker:
    """Steps per second by name, measured over at least `log_interval_s` seconds."""

    def __init__(self, log_interval_s: float = 5.0) -> None:
        self._span = log_interval_s
        self._counts: dict[str, tuple[float, float]] = {}
        self._rates: dict[str, float] = {}

    def record(self, name: str, count: int, step: int | None = None) -> None:
        """Add `count` steps to `name`."""
        del step
        if count <= 0:
            return
        now = time.perf_counter()
        so_far, since = self._counts.get(name, (0.0, now))
        so_far += count
        if now - since >= self._span:
            self._rates[name] = so_far / (now - since)
            so_far, since = 0.0, now
        self._counts[name] = so_far, since

    record_async = record

    def get_stats(self) -> dict[str, float]:
        """Return the latest rate of each name."""
        return dict(self._rates)
