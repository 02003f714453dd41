"""`Episode` and `Evaluation`: the episodes played, and statistics over them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlightning_aio.evaluation.estimates import Estimate, mean_estimate, wilson_estimate

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["Episode", "Evaluation", "Figures", "check_numbers"]


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that was played to its end.

    Attributes:
        env_id: of the env.
        sub_env: index of the sub-environment; 0 if the env has only one.
        number: of the episode, from 0, among those of its env or sub-environment.
        total_reward: the undiscounted return, summed over agents.
        length: in steps.
        success: ``success`` or ``is_success`` of the last info; None if it has neither.
    """

    env_id: str
    sub_env: int
    number: int
    total_reward: float
    length: int
    success: bool | None


def check_numbers(episodes: Iterable[Episode]) -> None:
    """Raise `ValueError` unless the episodes of each sub-environment have numbers 0, 1, 2, …"""
    counts = Counter[tuple[str, int]]()
    for episode in episodes:
        place = episode.env_id, episode.sub_env
        if episode.number != counts[place]:
            wrong = "is a duplicate" if episode.number < counts[place] else "is out of order"
            raise ValueError(
                f"episode {episode.number} of env {episode.env_id!r}, sub-environment "
                f"{episode.sub_env}, {wrong}"
            )
        counts[place] += 1


class Figures:
    """Estimates over episodes."""

    __slots__ = ()

    def _outcomes(self) -> Sequence[Any]:
        """Return the episodes to count, with `total_reward`, `length` and `success`."""
        raise NotImplementedError

    @property
    def returns(self) -> list[float]:
        """Return of each episode."""
        return [episode.total_reward for episode in self._outcomes()]

    @property
    def total_reward(self) -> Estimate | None:
        """Mean return, with Student's t interval; None without episodes."""
        return mean_estimate(self.returns)

    @property
    def length(self) -> Estimate | None:
        """Mean length in steps, with Student's t interval; None without episodes."""
        return mean_estimate([float(episode.length) for episode in self._outcomes()])

    @property
    def success(self) -> Estimate | None:
        """Success rate of episodes whose `success` is known, with Wilson's interval, or None."""
        judged = [one.success for one in self._outcomes() if one.success is not None]
        return wilson_estimate(sum(judged), len(judged))


@dataclass(slots=True)
class Evaluation(Figures):
    """Episodes of a policy, the same number of each env and sub-environment.

    Attributes:
        episodes: those given as played, then the new ones in the order of their ends.
        lost: number of episodes that were restarted because their worker ended.
    """

    episodes: list[Episode] = field(default_factory=list[Episode])
    lost: int = 0

    def _outcomes(self) -> Sequence[Any]:
        return self.episodes

    def of_envs(self, env_ids: Iterable[str]) -> Evaluation:
        """Select the episodes of some envs, without `lost`, which isn't counted by env."""
        wanted = set(env_ids)
        return Evaluation([episode for episode in self.episodes if episode.env_id in wanted])
