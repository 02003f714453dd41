"""`Numbers`: what `EnvGroup.metrics` has of the attempts of `play`, as sums over all its calls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, get_args

from rlightning_aio._core.group.api.facade import numbers_of_attempts
from rlightning_aio.outcomes import OutcomeKind

if TYPE_CHECKING:
    from rlightning_aio.attempts.clock import Clock
    from rlightning_aio.outcomes import Outcome

_NAMES: Final = (
    *("playing", "waiting", "groups_waiting", "lag", "seconds_blocked"),
    *("seconds_in_agents", "retries", *(f"outcomes_{kind}" for kind in get_args(OutcomeKind))),
)


class Numbers:
    """See the module; docs/metrics.md explains every number."""

    def __init__(self, group: Any) -> None:
        self._numbers = numbers_of_attempts(group)
        for name in _NAMES:
            self._numbers.setdefault(f"attempts/{name}", 0)
        self._blocked = 0.0

    def note(self, clock: Clock, **now: int) -> None:
        """Note how many attempts and groups there are now, and for how long nothing could run."""
        self._numbers.update({f"attempts/{name}": number for name, number in now.items()})
        self._numbers["attempts/lag"] = clock.lag
        self._add("seconds_blocked", clock.blocked - self._blocked)
        self._blocked = clock.blocked

    def note_end(self, outcome: Outcome, *, is_retried: bool) -> None:
        """Note the end of a try."""
        self._add("seconds_in_agents", outcome.seconds.agent)
        self._add("retries" if is_retried else f"outcomes_{outcome.kind}", 1)

    def _add(self, name: str, number: float) -> None:
        self._numbers[f"attempts/{name}"] += number
