"""`Rules`: when an attempt is tried again, and when a group of attempts is complete."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from rlightning_aio.outcomes import is_bystanders

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.outcomes import Outcome

__all__ = ["Rules", "is_retried", "needed", "tries_again"]


def is_retried(outcome: Outcome) -> bool:
    """Return True for a failure that neither the policy alone nor the caller has caused."""
    return outcome.is_failure and outcome.blame not in ("policy", "caller")


@dataclass(frozen=True, slots=True)
class Rules:
    """Rules of `play`.

    Attributes:
        attempt_timeout: seconds from the reset to the end of an attempt; None for no limit.
        on_timeout: then the attempt has failed (``fail``), or it ends as truncated, with what it
            has earned (``end``).
        retries: how often an attempt that has failed is tried again. A failure for which another
            env of the worker is to blame isn't counted, and one that the policy alone or the caller
            has caused is final.
        first: as soon as this many attempts have not failed, the group is complete, and the others
            are cancelled; None: it is complete if none has failed.
        max_concurrency: how many attempts may play at once; None for one on each env.

    Raises:
        ValueError: a number is out of its range, or `on_timeout` is none of the two.
    """

    attempt_timeout: float | None = None
    on_timeout: Literal["fail", "end"] = "fail"
    retries: int = 2
    first: int | None = None
    max_concurrency: int | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        if self.attempt_timeout is not None and not self.attempt_timeout > 0:
            raise ValueError(f"attempt_timeout must be positive, not {self.attempt_timeout!r}")
        if self.retries < 0:
            raise ValueError(f"retries must be at least 0, not {self.retries!r}")
        for name in ("first", "max_concurrency"):
            number: int | None = getattr(self, name)
            if number is not None and number < 1:
                raise ValueError(f"{name} must be at least 1, not {number!r}")
        if self.on_timeout not in ("fail", "end"):
            raise ValueError(f"on_timeout must be fail or end, not {self.on_timeout!r}")


def tries_again(rules: Rules, outcome: Outcome, before: Sequence[Outcome]) -> bool:
    """Return True if an attempt is tried again after a try, and those `before` that failed."""
    counted = sum(not is_bystanders(one) for one in before)
    return is_retried(outcome) and (is_bystanders(outcome) or counted < rules.retries)


def needed(rules: Rules, size: int) -> int:
    """Number of attempts, of `size`, that must not fail for their group to be complete."""
    return min(size, rules.first or size)
