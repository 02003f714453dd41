"""`Attempt`, `AttemptGroup`, and the file of attempts from which an interrupted run resumes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, overload

from rlightning_aio.attempts.file import EpisodeFile
from rlightning_aio.attempts.spec import EpisodeSpec, plain
from rlightning_aio.json_text import finite
from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator, Mapping

    from rlightning_aio.attempts.spec import EpisodeKey

__all__ = ["Attempt", "AttemptGroup", "AttemptsFile"]


@dataclass(slots=True)
class Attempt:
    """One attempt at a task, after its last try.

    Attributes:
        spec: the task.
        index: among the attempts at the task, from 0.
        outcome: how it ended.
        reward: the sum of `rewards`; None if it has failed.
        rewards: of each step, in order.
        columns: what the agent gave to `step` with each action, and ``action`` itself: lists with
            an element for each step, None where a step had no such column.
        first, last: copies of the observations after the reset and after the newest step; None
            without. If `zero_copy` views are in use, an attempt that was cut during a step may have
            the observation of that step as its last one.
        result: what the agent returned.
        failures: outcomes of earlier tries, in order.
    """

    spec: EpisodeSpec
    index: int
    outcome: Outcome
    reward: float | None = None
    rewards: list[float] = field(default_factory=list[float])
    columns: dict[str, list[Any]] = field(default_factory=dict[str, list[Any]])
    first: Any = None
    last: Any = None
    result: Any = None
    failures: tuple[Outcome, ...] = ()

    @property
    def length(self) -> int:
        """Number of steps."""
        return len(self.rewards)

    @property
    def env_id(self) -> str:
        """Id of the env that played it last; empty if none did."""
        return self.outcome.env_id

    def to_json(self) -> dict[str, Any]:
        """Return the attempt as a row of JSON, without observations.

        Columns and a result that JSON can't hold are null, and so are numbers that are not finite.
        """
        row = {
            **self.spec.to_json(),
            "index": self.index,
            "reward": self.reward,
            "rewards": self.rewards,
            "outcome": self.outcome.to_json(),
            "failures": [outcome.to_json() for outcome in self.failures],
            "columns": {name: _json_or_none(column) for name, column in self.columns.items()},
            "result": _json_or_none(self.result),
        }
        return finite(row)

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Attempt:
        """Make an attempt from its row.

        Raises:
            TypeError, ValueError, KeyError: it is not such a row.
        """
        fields = {**row}
        names = ("task", "seed", "options", "entry")
        spec = EpisodeSpec(**{name: fields.pop(name) for name in names})
        outcome = Outcome.from_json(fields.pop("outcome"))
        failures = tuple(map(Outcome.from_json, fields.pop("failures")))
        rewards = [math.nan if reward is None else reward for reward in fields.pop("rewards")]
        reward = None if outcome.is_failure else sum(rewards)
        del fields["reward"]  # Null, too, where it is not finite.
        return cls(
            spec, outcome=outcome, failures=failures, rewards=rewards, reward=reward, **fields
        )


def _json_or_none(value: Any) -> Any:
    try:
        return json.loads(json.dumps(value, default=plain, allow_nan=False))
    except (TypeError, ValueError):
        return None


@dataclass(slots=True)
class AttemptGroup(Sequence[Attempt]):
    """All attempts at one task, in the order of their indices.

    Attributes:
        spec: the task.
        attempts: all of them, failed and cancelled ones included.
        is_complete: as many have not failed as the rules ask for.
    """

    spec: EpisodeSpec
    attempts: list[Attempt]
    is_complete: bool

    @property
    def rewards(self) -> list[float]:
        """Rewards of the attempts that have one."""
        return [attempt.reward for attempt in self.attempts if attempt.reward is not None]

    @overload
    def __getitem__(self, index: int) -> Attempt: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Attempt]: ...

    def __getitem__(self, index: int | slice) -> Attempt | Sequence[Attempt]:
        """The attempt of an index."""
        return self.attempts[index]

    def __len__(self) -> int:
        """The number of attempts."""
        return len(self.attempts)

    def __iter__(self) -> Iterator[Attempt]:
        return iter(self.attempts)


class AttemptsFile(EpisodeFile[Attempt]):
    """Attempts as JSON lines, for this process alone; `play` continues from it.

    A line holds an attempt after its last try. Cancelled attempts are not written: with
    ``Rules(first=…)`` a task is done when as many others are in the file.

    Args:
        path: the file, created if it is missing; a link is followed.
        subject: what plays, as JSON values: the first line of the file. A file with another subject
            is refused.

    Attributes:
        played: the attempts in the file.

    Raises:
        ConfigError: the file can't be read and written, another process has it open, it belongs to
            something else, or it is damaged.
    """

    def __init__(
        self, path: str | os.PathLike[str], subject: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(path, subject or {}, label="file of attempts")

    def by_task(self) -> dict[EpisodeKey, dict[int, list[Attempt]]]:
        """The attempts in the file by the `key` of their task, and by index.

        There is more than one of an index where the same task was there several times.
        """
        found: dict[EpisodeKey, dict[int, list[Attempt]]] = {}
        for attempt in self.played:
            by_index = found.setdefault(attempt.spec.key, {})
            by_index.setdefault(attempt.index, []).append(attempt)
        return found

    def _encode(self, episode: Attempt) -> dict[str, Any]:
        return episode.to_json()

    def _decode(self, value: dict[str, Any]) -> Attempt | None:
        return Attempt.from_json(value)

    def _check(self, played: list[Attempt]) -> None:
        """Any attempt may be there again, where a task is."""
