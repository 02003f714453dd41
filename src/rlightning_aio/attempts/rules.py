"""`Rules`: when an attempt is tried again, and when a group of attempts is complete."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from rlightning_aio.outcomes import is_bystanders

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.outcomes import Outcome

_OF_ENVS: Final = ("env_raised", "env_died", "env_hung", "env_away", "not_started")


def is_retried(outcome: Outcome) -> bool:
    """Return True for a failure that neither the policy alone, the caller nor a time limit of the
    attempt has caused.
    """
    return not (is_final(outcome) or outcome.blame == "caller" or outcome.kind == "timed_out")


def is_final(outcome: Outcome) -> bool:
    """Return True unless a run that is resumed plays the attempt again."""
    return not outcome.is_failure or outcome.blame == "policy"


def is_of_env(outcome: Outcome) -> bool:
    """Return True for a failure of the env itself, and not of a neighbour in its worker."""
    return is_from_env(outcome) and not is_bystanders(outcome)


def is_unnamed(outcome: Outcome) -> bool:
    """Return True if its worker has died while several envs were waiting in it."""
    return outcome.kind == "env_died" and outcome.blame == "infrastructure" and is_of_env(outcome)


def is_from_env(outcome: Outcome) -> bool:
    """Return True for a failure that the env has not survived, whoever is at fault."""
    return outcome.kind in _OF_ENVS


@dataclass(frozen=True, slots=True)
class Rules:
    """Rules of `play`.

    Attributes:
        attempt_timeout: seconds that an attempt may run, with its reset; None for no limit. It does
            not run while something blocks the event loop, and while a step waits in the queue of
            the entry's `max_concurrency`.
        on_timeout: then the attempt has failed (``fail``), or it ends with what it has earned, as
            truncated unless its env has ended it (``end``). Without a completed step it has failed
            all the same, and if a step has taken more than half of the time, it is ``env_hung``.
        retries: how often an attempt that has failed is tried again, on another env than before. A
            failure for which another env of the worker is to blame isn't counted, and neither are
            those with which an outage begins: most attempts fail, after one has succeeded. What the
            policy alone or the caller has caused isn't tried again, nor is ``timed_out``. After the
            death of a worker in which several were executed, each of them is tried again in a
            worker where nobody else plays.
        first: as soon as this many attempts have not failed, the group is complete, and the others
            are cancelled; None: it is complete if none has failed.
        max_concurrency: how many attempts may play at once; None for one on each env. As many
            other envs, if there are, reset meanwhile for the attempts that come next.
        max_failures: the share of the last hundred attempts that may fail, after their last try. If
            more have failed, `play` ends with an error that counts them by kind; None never ends
            it.

    Raises:
        ValueError: a number is out of its range, or `on_timeout` is none of the two.
    """

    attempt_timeout: float | None = None
    on_timeout: Literal["fail", "end"] = "fail"
    retries: int = 2
    first: int | None = None
    max_concurrency: int | None = None
    max_failures: float | None = None

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
        if self.max_failures is not None and not 0 <= self.max_failures <= 1:
            raise ValueError(f"max_failures must be a share, 0 to 1, not {self.max_failures!r}")
        if self.on_timeout not in ("fail", "end"):
            raise ValueError(f"on_timeout must be fail or end, not {self.on_timeout!r}")


def tries_again(
    rules: Rules, outcome: Outcome, before: Sequence[Outcome], num_excused: int
) -> bool:
    """Return True if an attempt is tried again after a try, and those `before` that failed.

    Its first `num_excused` failures don't count.
    """
    counted = sum(not is_bystanders(one) for one in before[num_excused:])
    is_excused = is_bystanders(outcome) or len(before) < num_excused
    return is_retried(outcome) and (is_excused or counted < rules.retries)


def needed(rules: Rules, size: int) -> int:
    """Number of attempts, of `size`, that must not fail for their group to be complete."""
    return min(size, rules.first or size)
