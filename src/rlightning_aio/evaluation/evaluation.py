"""`Evaluation`: the episodes of a policy, and statistics over them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from statistics import fmean
from typing import Literal

from rlightning_aio.attempts.records import Attempt
from rlightning_aio.evaluation.estimates import Estimate, mean_estimate, wilson_estimate
from rlightning_aio.outcomes import is_bystanders


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
        """Success rate of episodes whose `success` is known, with Wilson's interval, or None.

        Values above 0.5 are successes. `remarks` say what is left out.
        """
        values = self._success_values
        return wilson_estimate(sum(value > 0.5 for value in values), len(values))

    @property
    def success_value(self) -> Estimate | None:
        """Mean of the values from which `success` is counted, with Student's t interval."""
        return mean_estimate(self._success_values)

    @property
    def _success_values(self) -> list[float]:
        return [one.success_value or 0.0 for one in self.played if one.success is not None]

    @property
    def remarks(self) -> list[str]:
        """Notes on the figures, in words: values that are no verdicts, and what is
        left out of the success rate.
        """
        found, values = list[str](), self._success_values
        known = sum(one.success_value is not None for one in self.played)
        if not known:
            return found
        if any(value not in (0, 1) for value in values):
            found.append(
                f"a success is a value above 0.5; the mean of the values is {fmean(values):.4g}"
            )
        left_out = len(self.attempts) - len(values)
        if left_out:
            failed, silent = len(self.failed), len(self.played) - known
            parts = [f"{failed} failed"] * bool(failed)
            parts += [f"{silent} with no success in the last info"] * bool(silent)
            parts += [f"{known - len(values)} whose success is NaN"] * (known > len(values))
            least = sum(value > 0.5 for value in values) / len(self.attempts)
            found.append(
                f"the success rate leaves out {' and '.join(parts)} of {len(self.attempts)} "
                f"episodes: {least:.1%} if they count as failures"
            )
        return found

    def by_task(self) -> dict[str, Evaluation]:
        """Split by task, in alphabetical order."""
        return parts_of(self, "task")

    def __str__(self) -> str:
        """A table with a line for each task, and the `remarks`."""
        return "\n".join([table_of(self, "task"), *self.remarks])


def table_of(found: Evaluation, name: Literal["entry", "task"]) -> str:
    """Return a table with a line for each part by a field of the episodes' specs, and for all."""
    parts = [*parts_of(found, name).items()]
    parts += [("all", found)] if len(parts) != 1 else []
    head = (name, "episodes", "success", "return", "length", "failed")
    rows = [head, *(_row(own_name, part) for own_name, part in parts)]
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
