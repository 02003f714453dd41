"""`Member`: what the fleet knows of one host, from its first start to its end."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rlightning_aio.hosts.worker import ErrorText, Started

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.errors import WorkerDied
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.hosts.worker import AttachOrder

__all__ = ["NOBODY", "Member", "Stage"]

NOBODY: Final = -1
"""In place of a slot."""


class Stage(Enum):
    """How far a host has come."""

    NEW = auto()
    BUILDING = auto()
    BUILT = auto()
    ATTACHING = auto()
    UP = auto()
    FAILED = auto()
    CLOSED = auto()


@dataclass
class Member:
    """See the module.

    Attributes:
        start_by: when it must be up; late: it wasn't, and is being killed.
        deaths: by slot, of workers that died while they executed that env, since the env
            last completed a step; culprit: the slot of the last one.
        hung_slot: the env for which it is being killed.
        idle: how far it had got when it was last seen to do nothing (`Fleet._progress`).
    """

    host: Host
    config: EnvConfig
    stage: Stage = Stage.NEW
    started: list[Started] = field(default_factory=list[Started])
    order: AttachOrder | None = None
    start_by: float | None = None
    late: bool = False
    deaths: dict[int, int] = field(default_factory=dict[int, int])
    culprit: int = NOBODY
    hung_slot: int | None = None
    idle: tuple[int, ...] = ()
    idle_since: float = 0.0
    rebuild_error: ErrorText | None = None
    failure: Callable[[], WorkerDied] | None = None

    @property
    def timed(self) -> bool:
        """Whether any of its requests has a time limit."""
        return not self.host.elastic and (
            self.config.step_timeout is not None or self.config.reset_timeout is not None
        )
