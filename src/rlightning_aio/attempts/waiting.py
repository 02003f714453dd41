"""`WaitingEpisodes`: the episodes of an entry that wait for an env, by task.

Rule: to switch to another task takes an env tens of milliseconds to seconds, so an env continues
with its own task while episodes of it wait. After that it takes up the task of which the most
episodes wait for each env. So the episodes of a long task are shared in the end.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rlightning_aio.attempts.spec import EpisodeSpec

__all__ = ["WaitingEpisodes"]


class Waits(Protocol):
    """What can wait."""

    @property
    def spec(self) -> EpisodeSpec: ...


W = TypeVar("W", bound=Waits)


class WaitingEpisodes(Generic[W]):
    """Episodes that wait, those of a task in the order in which they were added."""

    def __init__(self) -> None:
        self._by_task: dict[str, deque[W]] = {}

    def __len__(self) -> int:
        return sum(map(len, self._by_task.values()))

    def remove(self, is_unwanted: Callable[[W], bool]) -> list[W]:
        """Remove those episodes that a function returns True for, and return them."""
        removed: list[W] = []
        for task, waiting in list(self._by_task.items()):
            removed += filter(is_unwanted, waiting)
            kept = deque(one for one in waiting if not is_unwanted(one))
            if kept:
                self._by_task[task] = kept
            else:
                del self._by_task[task]
        return removed

    def add(self, episode: W) -> None:
        """Add an episode as the last of its task."""
        self._by_task.setdefault(episode.spec.task, deque()).append(episode)

    def take(self, own: str, others: Iterable[str]) -> W:
        """Remove the episode that an env is to play.

        Args:
            own: the task that the env has.
            others: the tasks that other envs have.
        """
        task = own if own in self._by_task else self._neediest(Counter(others))
        waiting = self._by_task[task]
        episode = waiting.popleft()
        if not waiting:
            del self._by_task[task]
        return episode

    def _neediest(self, players: Counter[str]) -> str:
        return max(self._by_task, key=lambda task: len(self._by_task[task]) / (1 + players[task]))
