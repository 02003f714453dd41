"""`EpisodeRecord` and `QueueEvaluation`: what became of an episode of a queue, and all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlightning_aio.attempts.spec import EpisodeSpec, written
from rlightning_aio.evaluation.episodes import Figures

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio.attempts.spec import EpisodeKey

__all__ = ["EpisodeRecord", "QueueEvaluation"]


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """The outcome of one episode of a queue.

    Attributes:
        entry, task, seed, options: the episode, as in `EpisodeSpec`.
        env_id: of the env that played it, or lost it last.
        total_reward: the undiscounted return, summed over agents; None if it wasn't played.
        length: in steps; None if it wasn't played.
        success: ``success`` or ``is_success`` of the last info; None if it has neither.
        cause: why the episode failed, if each attempt was lost; None if it was played to its end.
        lost: why attempts were lost, in order.
    """

    entry: str
    task: str
    seed: int
    options: Mapping[str, Any] | None
    env_id: str
    total_reward: float | None
    length: int | None
    success: bool | None
    cause: str | None = None
    lost: tuple[str, ...] = ()

    @property
    def key(self) -> EpisodeKey:
        """Identity of the episode; equal to that of its `EpisodeSpec`."""
        return self.entry, self.task, self.seed, written(self.options)

    def to_json(self) -> dict[str, Any]:
        """Return the record as a row of JSON, with ``return`` for the total reward.

        A return that is not finite is null, which JSON lacks a number for.
        """
        total = self.total_reward
        return {
            **EpisodeSpec(self.task, self.seed, self.options, self.entry).to_json(),
            "return": total if total is not None and math.isfinite(total) else None,
            "length": self.length,
            "success": self.success,
            "cause": self.cause,
            "lost": list(self.lost),
            "env_id": self.env_id,
        }

    @classmethod
    def from_json(cls, row: dict[str, Any]) -> EpisodeRecord:
        """Make a record from its row.

        Raises:
            TypeError, KeyError: it is not such a row.
        """
        fields = {**row}
        total, lost = fields.pop("return"), fields.pop("lost")
        if total is None and fields["cause"] is None:
            total = math.nan
        return cls(total_reward=total, lost=tuple(lost), **fields)


@dataclass(slots=True)
class QueueEvaluation(Figures):
    """The episodes of a queue, with estimates over those that were played to their end.

    Attributes:
        records: those given as played, then the new ones in the order of their ends.
    """

    records: list[EpisodeRecord] = field(default_factory=list[EpisodeRecord])

    def _outcomes(self) -> Sequence[Any]:
        return [record for record in self.records if record.cause is None]

    @property
    def failed(self) -> list[EpisodeRecord]:
        """Episodes without a result, because each attempt was lost."""
        return [record for record in self.records if record.cause is not None]

    @property
    def lost(self) -> int:
        """Number of lost attempts."""
        return sum(len(record.lost) for record in self.records)

    def by_task(self) -> dict[str, QueueEvaluation]:
        """Split by task, in alphabetical order."""
        found: dict[str, QueueEvaluation] = {}
        for record in sorted(self.records, key=lambda record: record.task):
            found.setdefault(record.task, QueueEvaluation()).records.append(record)
        return found
