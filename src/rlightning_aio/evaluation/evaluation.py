"""`Evaluation`: the episodes of a policy, and statistics over them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

from rlightning_aio.attempts.records import Attempt
from rlightning_aio.evaluation.estimates import Estimate, mean_estimate, wilson_estimate
from rlightning_aio.outcomes import is_bystanders

__all__ = ["Evaluation", "parts_of"]


@dataclass(slots=True)
class Evaluation:
    """The episodes of a policy. Failed ones have no return: they are counted, and never averaged.

    Attributes:
        attempts: each episode after its last try: those of the results file, then the others in the
            order of their ends.
    """

    attempts: list[Attempt] = field(default_factory=list[Attempt])

    @property
    def played(self) -> list[Attempt]:
        """Episodes that have an end of their own, and so a return."""
        return [attempt for attempt in self.attempts if not attempt.outcome.is_failure]

    @property
    def failed(self) -> list[Attempt]:
        """Episodes whose every try was lost, by an exception or with their worker."""
        return [attempt for attempt in self.attempts if attempt.outcome.is_failure]

    @property
    def failures(self) -> Counter[str]:
        """Number of tries that have failed, by the kind of their outcome.

        Those are left out in which another env of the worker was at fault.
        """
        tries = [one for attempt in self.attempts for one in attempt.failures]
        tries += [attempt.outcome for attempt in self.failed]
        return Counter(one.kind for one in tries if not is_bystanders(one))

    @property
    def returns(self) -> list[float]:
        """Return of each episode that was played."""
        return [attempt.reward for attempt in self.attempts if attempt.reward is not None]

    @property
    def total_reward(self) -> Estimate | None:
        """Mean return, with Student's t interval; None without episodes."""
        return mean_estimate(self.returns)

    @property
    def length(self) -> Estimate | None:
        """Mean length in steps, with Student's t interval; None without episodes."""
        return mean_estimate([float(attempt.length) for attempt in self.played])

    @property
    def success(self) -> Estimate | None:
        """Success rate of episodes whose `success` is known, with Wilson's interval, or None."""
        judged = [attempt.success for attempt in self.played if attempt.success is not None]
        return wilson_estimate(sum(judged), len(judged))

    def by_task(self) -> dict[str, Evaluation]:
        """Split by task, in alphabetical order."""
        return parts_of(self, "task")

    def __str__(self) -> str:
        """A table with a line for each task."""
        by_task = self.by_task()
        parts = [*by_task.items()] if len(by_task) == 1 else [*by_task.items(), ("all", self)]
        head = ("task", "episodes", "success", "return", "length", "failed")
        rows = [head, *(_row(task, part) for task, part in parts)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = (
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            for row in rows
        )
        return "\n".join(line.rstrip() for line in lines)


def parts_of(found: Evaluation, name: Literal["entry", "task"]) -> dict[str, Evaluation]:
    """Split by a field of the episodes' specs, in alphabetical order."""
    parts: dict[str, Evaluation] = {}
    for attempt in found.attempts:
        parts.setdefault(getattr(attempt.spec, name), Evaluation()).attempts.append(attempt)
    return dict(sorted(parts.items()))


def _row(task: str, found: Evaluation) -> tuple[str, ...]:
    estimates = [found.success, found.total_reward, found.length]
    cells = ["-" if one is None else str(one) for one in estimates]
    return (task or "-", str(len(found.attempts)), *cells, str(len(found.failed)))
