"""What an entry allows its envs: time for a request, and restarts in a row."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from rlightning_aio._core.hosts import times
from rlightning_aio.envs.adapted.films import RECORD_VIDEO
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

_FIRST_SECONDS: Final = 0.1
_LONGEST_SECONDS: Final = 5.0


def limits_of(config: EnvConfig) -> dict[int, float]:
    """The time limits of requests in seconds, by operation; one without a limit is absent."""
    limits = {Operation.STEP: config.step_timeout, Operation.RESET: config.reset_timeout}
    return {int(op): limit for op, limit in limits.items() if limit is not None}


def close_seconds(config: EnvConfig, *, awaits: bool) -> float:
    """Return how long a host may take to close its envs, which are awaitable or not, and to end."""
    seconds = config.close_timeout
    if awaits:
        return (times.AWAITED_CLOSE if seconds is None else seconds) + times.AWAITED_CANCEL
    usual = times.FILMED_CLOSE if RECORD_VIDEO in config.env_kwargs else times.CLOSE
    return usual if seconds is None else seconds


def restart_pause(losses: int) -> float:
    """Return the seconds to wait before the restart that follows `losses` losses in a row.

    The first restart is immediate, the second comes after a tenth of a second, and each later one
    after twice the previous pause, up to five seconds.
    """
    if losses <= 1:
        return 0.0
    return min(_FIRST_SECONDS * 2.0 ** min(losses - 2, 10), _LONGEST_SECONDS)


def hung(cause: str, op: int, at_fault: str | None) -> Loss:
    """Return the loss of an env that has exceeded the time limit of an operation.

    A step executes an action and a call has arguments, which may be why it takes so long.
    """
    blame = "either" if op in (Operation.STEP, Operation.CALL) else "env"
    return Loss(cause, "env_hung", blame, at_fault)


class RestartPolicy:
    """How many losses in a row an entry bears, of a worker or of an env.

    Args:
        config: of the entry.
        field: of the entry, says whether any is borne: ``on_worker_death`` or ``on_env_error``.

    Attributes:
        raises: no loss is borne.
    """

    def __init__(
        self, config: EnvConfig, field: Literal["on_worker_death", "on_env_error"]
    ) -> None:
        self.raises = getattr(config, field) == "raise"
        self._field = field
        self._most = config.max_restarts

    def count(self, losses: int, *, pauses: bool = True) -> tuple[bool, str]:
        """Return True if a restart follows a loss, and say in a clause what follows.

        Args:
            losses: in a row, this one included.
            pauses: a restart waits for `restart_pause`.
        """
        again = "the next request tries again"
        if self.raises:
            return False, f"{self._field} is 'raise'; {again}"
        if losses > self._most:
            return False, f"{losses - 1} restarts in a row (max_restarts) came before it; {again}"
        pause = restart_pause(losses) if pauses else 0.0
        after = f", in {pause:g} s" if pause else ""
        return True, f"restart {losses} of {self._most} in a row{after}"
