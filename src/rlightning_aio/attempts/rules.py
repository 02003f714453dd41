"""`Rules`: when an attempt is tried again, and when a group of attempts is complete."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from rlightning_aio.outcomes import is_bystanders

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio.attempts.spec import EpisodeSpec
    from rlightning_aio.outcomes import Outcome

__all__ = ["Rules", "is_retried", "needed", "seed_of", "tries_again"]

_SEED_BITS: Final = 2


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
            env of the worker is to blame isn't counted.
        retried: which outcomes are; by default those whose blame is neither ``policy`` nor
            ``caller``.
        at_least: a group is complete if this many attempts have not failed; None for all of them.
        first: as soon as this many attempts have not failed, the group is complete, and the others
            are cancelled; None for never.
        seeds: attempts at a task have the ``same`` seed, or ``distinct`` ones, made of the seed and
            the index of the attempt.
        max_concurrency: how many attempts may play at once; None for one on each env.

    Raises:
        ValueError: a number is out of its range, or both `at_least` and `first` are given.
    """

    attempt_timeout: float | None = None
    on_timeout: Literal["fail", "end"] = "fail"
    retries: int = 2
    retried: Callable[[Outcome], bool] = is_retried
    at_least: int | None = None
    first: int | None = None
    seeds: Literal["same", "distinct"] = "same"
    max_concurrency: int | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        if self.attempt_timeout is not None and not self.attempt_timeout > 0:
            raise ValueError(f"attempt_timeout must be positive, not {self.attempt_timeout!r}")
        if self.retries < 0:
            raise ValueError(f"retries must be at least 0, not {self.retries!r}")
        for name in ("at_least", "first", "max_concurrency"):
            number: int | None = getattr(self, name)
            if number is not None and number < 1:
                raise ValueError(f"{name} must be at least 1, not {number!r}")
        for name, known in (("on_timeout", ("fail", "end")), ("seeds", ("same", "distinct"))):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}")
        if self.at_least is not None and self.first is not None:
            raise ValueError("at_least and first exclude each other")


def seed_of(rules: Rules, spec: EpisodeSpec, index: int) -> int | None:
    """The seed of an attempt."""
    if rules.seeds == "same" or spec.seed is None:
        return spec.seed
    state = np.random.SeedSequence((spec.seed, index)).generate_state(1, np.uint64)
    return int(state[0]) >> _SEED_BITS


def tries_again(rules: Rules, outcome: Outcome, before: Sequence[Outcome]) -> bool:
    """Return True if an attempt is tried again after a try, and those `before` that failed."""
    counted = sum(not is_bystanders(one) for one in before)
    return rules.retried(outcome) and (is_bystanders(outcome) or counted < rules.retries)


def needed(rules: Rules, size: int) -> int:
    """Number of attempts, of `size`, that must not fail for their group to be complete."""
    return min(size, rules.first or rules.at_least or size)
