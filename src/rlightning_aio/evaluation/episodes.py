"""`Episode` and `Evaluation`: what was played, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rlightning_aio.evaluation.estimates import Estimate, mean_estimate, wilson_estimate

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["Episode", "Evaluation"]


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that was played to its end.

    Attributes:
        env_id: of the env.
        sub_env: which of its sub-environments; 0 where there is one.
        number: of the episode, from 0, among those of its env or sub-environment.
        total_reward: the return, undiscounted; of several agents the sum.
        length: in steps.
        success: what its last info says under ``success`` or ``is_success``; None where that
            says nothing.
    """

    env_id: str
    sub_env: int
    number: int
    total_reward: float
    length: int
    success: bool | None


@dataclass(slots=True)
class Evaluation:
    """Episodes of a policy, equally many of each env and sub-environment.

    Attributes:
        episodes: in the order in which they ended, those that were given first.
        lost: episodes that were begun anew, as their worker had ended in them.
    """

    episodes: list[Episode] = field(default_factory=list[Episode])
    lost: int = 0

    @property
    def total_reward(self) -> Estimate | None:
        """The mean return, with Student's t interval; None without an episode."""
        return mean_estimate([episode.total_reward for episode in self.episodes])

    @property
    def length(self) -> Estimate | None:
        """The mean length in steps, with Student's t interval; None without an episode."""
        return mean_estimate([float(episode.length) for episode in self.episodes])

    @property
    def success(self) -> Estimate | None:
        """The success rate, with Wilson's interval, of the episodes that were judged.

        None if none was.
        """
        judged = [episode.success for episode in self.episodes if episode.success is not None]
        return wilson_estimate(sum(judged), len(judged))

    def of_envs(self, env_ids: Iterable[str]) -> Evaluation:
        """The episodes of some envs; those that were lost are told of all envs together."""
        wanted = set(env_ids)
        return Evaluation([episode for episode in self.episodes if episode.env_id in wanted])
