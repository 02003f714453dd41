"""`HostRecord`: what the supervisor knows of one host, from its first start to its end."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, Any

from rlightning_aio.hosts.base import Killable
from rlightning_aio.registry import placement_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.errors import WorkerDied
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.hosts.messages import AttachOrder, EnvStarted, ErrorText

__all__ = ["HostRecord", "Stage"]


class Stage(Enum):
    """How far a host has come."""

    NEW = auto()
    BUILDING = auto()
    BUILT = auto()
    ATTACHING = auto()
    UP = auto()
    DOWN = auto()
    """Dead; it will be started again."""
    FAILED = auto()
    CLOSED = auto()


@dataclass
class HostRecord:
    """See the module.

    Attributes:
        start_by: when it must be up; late: it wasn't, and is being killed.
        restart_at: when a dead one is started again; restarts: how often one was.
        held: what was asked of it since it died, entries and arguments, until a replacement is
            up; None while none is needed.
        deaths: by slot, of workers that died while they executed that env, since the env
            last completed a step; None where no env is known. culprit: the last one's.
        dying: it was killed, and that has not been told yet; die_by: when it must have been.
        hung_slot: the env for which it is being killed.
        idle: how far it had got when it was last seen to do nothing (`Supervisor._progress`).
        failure: makes the error for a caller that asks a host that was given up.
        killable: the host, if it can be ended by force.
        is_local: its envs use this machine's cores.
        timed: any of its requests has a time limit, which the supervisor must watch.
    """

    host: Host
    config: EnvConfig
    stage: Stage = Stage.NEW
    started: list[EnvStarted] = field(default_factory=list["EnvStarted"])
    order: AttachOrder | None = None
    start_by: float | None = None
    late: bool = False
    restart_at: float | None = None
    restarts: int = 0
    held: list[tuple[NDArray[np.int64], Sequence[Any] | None]] | None = None
    deaths: dict[int | None, int] = field(default_factory=dict[int | None, int])
    culprit: int | None = None
    dying: bool = False
    die_by: float | None = None
    hung_slot: int | None = None
    idle: tuple[int, ...] = ()
    idle_since: float = 0.0
    rebuild_error: ErrorText | None = None
    failure: Callable[[], WorkerDied] | None = None
    killable: Killable | None = field(init=False)
    timed: bool = field(init=False)
    is_local: bool = field(init=False)

    def __post_init__(self) -> None:
        limits = (self.config.step_timeout, self.config.reset_timeout)
        self.killable = self.host if isinstance(self.host, Killable) else None
        self.timed = self.killable is not None and limits != (None, None)
        self.is_local = placement_of(self.config.backend, self.config.placement).local

    @property
    def slots(self) -> range:
        """Of its envs."""
        return range(self.host.first_slot, self.host.first_slot + self.host.num_envs)

    def kill(self, *, dump: bool) -> None:
        """End it, if it can be ended."""
        if self.killable is not None:
            self.killable.kill(dump=dump)
