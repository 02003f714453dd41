"""`HostLoss`: one death of a worker, with its errors and what it means for the envs.

`Supervisor` decides what it means, and `Intake` carries it out. A record of a host keeps the loss
until the next one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import Death
    from rlightning_aio.errors import WorkerDied

__all__ = ["HostLoss", "last_lines"]


@dataclass(frozen=True, eq=False)
class HostLoss:
    """The loss of the states of a host's envs, described when it was found.

    Attributes:
        host_id, slots: of the host.
        owed: its slots with a request in flight.
        death: of its worker, with the cause as the group knows it.
        replaced: a replacement is started; else the host is given up.
        resets: the replacement may reset envs on its own; False of hardware, which only the user
            sets in motion.
        kind: of its errors.
        what: the subject and the cause; last: the last request of the env at fault.
        outcome: what happens to the worker now.
        env_ids: of all envs of the group, by slot.
        env_id: of the env at fault, or else of one that its errors name.
        at_fault: the id of the env that the worker was executing; None if unknown.
        suspects: ids; see `WorkerDied`.
    """

    host_id: int
    slots: range
    owed: NDArray[np.intp]
    death: Death
    replaced: bool
    resets: bool
    kind: type[WorkerDied]
    what: str
    last: str
    outcome: str
    env_ids: Sequence[str]
    env_id: str
    at_fault: str | None
    suspects: tuple[str, ...]

    @property
    def message(self) -> str:
        """All that is known of it, in one line."""
        return self._message(self.owed)

    def error(self, owed: NDArray[np.intp]) -> WorkerDied:
        """The error of requests that were in flight, with the last lines of the worker's stderr."""
        return self._error(self._message(owed), owed)

    def refusal(self, asked: NDArray[np.intp]) -> WorkerDied:
        """The error for new requests to `asked`, slots of a worker that is not replaced."""
        names = ", ".join(self._ids(asked))
        return self._error(f"{self.message}; nothing was sent to {names}", asked)

    def silent(self, lost: NDArray[np.intp]) -> WorkerDied:
        """The error for `lost`, slots that had replied, but whose states are gone."""
        names = ", ".join(self._ids(lost))
        return self._error(f"{self.message}; lost with it: {names}", lost)

    def _message(self, owed: NDArray[np.intp]) -> str:
        names = ", ".join(self._ids(owed)) or "none"
        return f"{self.what} ({self.last}; envs that owed a reply: {names}); {self.outcome}"

    def _error(self, message: str, slots: NDArray[np.intp]) -> WorkerDied:
        tail = self.death.stderr_tail
        error = self.kind(
            message + last_lines(tail),
            env_id=self.env_id,
            exit_code=self.death.exit_code,
            stderr_tail=tail,
        )
        error.env_ids = tuple(self._ids(slots))
        error.suspects = self.suspects
        return error

    def _ids(self, slots: NDArray[np.intp]) -> list[str]:
        chosen: list[int] = slots.tolist()
        return [self.env_ids[slot] for slot in chosen]


def last_lines(stderr_tail: str) -> str:
    """The end of a message: what a worker wrote at last."""
    lines = stderr_tail.strip().splitlines()[-20:]
    return ("\nThe last lines it wrote:\n  " + "\n  ".join(lines)) if lines else ""
