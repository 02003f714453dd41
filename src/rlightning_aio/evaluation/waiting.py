"""`WaitingEpisodes`: the episodes of an entry that wait for an env, by task.

Rule: to switch to another task takes an env tens of milliseconds to seconds, so an env continues
with its own task while episodes of it wait. After that it takes up the task of which the most
episodes wait for each env. So the episodes of a long task are shared in the end.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio.evaluation.records import EpisodeSpec

__all__ = ["Attempts", "WaitingEpisodes"]


@dataclass(slots=True)
class Attempts:
    """An episode that is waiting or playing, and why earlier attempts were lost."""

    spec: EpisodeSpec
    lost: list[str] = field(default_factory=list[str])


class WaitingEpisodes:
    """Episodes that wait, those of a task in the order in which they were added."""

    def __init__(self) -> None:
        self._by_task: dict[str, deque[Attempts]] = {}

    def __bool__(self) -> bool:
        return bool(self._by_task)

    def add(self, attempts: Attempts) -> None:
        """Add an episode as the last of its task."""
        self._by_task.setdefault(attempts.spec.task, deque()).append(attempts)

    def take(self, own: str, others: Iterable[str]) -> Attempts:
        """Remove the episode that an env is to play.

        Args:
            own: the task that the env has.
            others: the tasks that other envs have.
        """
        task = own if own in self._by_task else self._neediest(Counter(others))
        waiting = self._by_task[task]
        attempts = waiting.popleft()
        if not waiting:
            del self._by_task[task]
        return attempts

    def _neediest(self, players: Counter[str]) -> str:
        return max(self._by_task, key=lambda task: len(self._by_task[task]) / (1 + players[task]))
