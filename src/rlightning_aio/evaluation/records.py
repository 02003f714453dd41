"""`EpisodeSpec`, `EpisodeRecord` and `QueueEvaluation`: an episode to play, its outcome, and all of
them.

Rule: an episode is identified by its entry, task, seed and options; the env that plays it doesn't
matter.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlightning_aio._core.group.episodes.seeds import checked_seed
from rlightning_aio.evaluation.episodes import Figures

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["EpisodeKey", "EpisodeRecord", "EpisodeSpec", "QueueEvaluation"]

EpisodeKey = tuple[str, str, int, str]
"""Entry, task, seed and options of an episode, the last as JSON."""


@dataclass(frozen=True, slots=True)
class EpisodeSpec:
    """An episode to play.

    Attributes:
        task: name of the task; empty for the task of the config entry.
        seed: of the reset.
        options: further options of the reset, such as the number of an initial state.
        entry: name of the config entry; empty for the one whose envs can play the task.

    Raises:
        ValueError: `seed` is no int from 0 to 2**62 - 1, a name is no str, or `options` are no dict
            or can't be written as JSON. Numbers and arrays of NumPy can.
    """

    task: str
    seed: int
    options: Mapping[str, Any] | None = None
    entry: str = ""

    def __post_init__(self) -> None:
        """Check the fields, and convert the seed, which may be a number of NumPy."""
        object.__setattr__(self, "seed", checked_seed(self.seed))
        names: dict[str, Any] = {"task": self.task, "entry": self.entry}
        for what, name in names.items():
            if not isinstance(name, str):
                raise ValueError(f"the {what} of an episode should be a str, not {name!r}")
        options: Any = self.options
        if not isinstance(options, Mapping | None):
            raise ValueError(f"the options of an episode should be a dict, not {options!r}")
        try:
            _written(self.options)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the options of an episode can't be written as JSON: {error}"
            ) from error

    @property
    def key(self) -> EpisodeKey:
        """Identity of the episode."""
        return self.entry, self.task, self.seed, _written(self.options)

    def to_json(self) -> dict[str, Any]:
        """Return the episode as a row of JSON."""
        return {
            "entry": self.entry,
            "task": self.task,
            "seed": self.seed,
            "options": None if self.options is None else json.loads(_written(self.options)),
        }


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
        return self.entry, self.task, self.seed, _written(self.options)

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


def _written(options: Mapping[str, Any] | None) -> str:
    if options is None:
        return ""
    return json.dumps(options, sort_keys=True, default=_plain, allow_nan=False)


def _plain(value: Any) -> Any:
    if not hasattr(value, "tolist"):
        raise TypeError(f"{value!r} is neither a number, a text, a list nor an array")
    return value.tolist()


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
