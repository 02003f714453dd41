"""`HostRecord`: the supervisor's state of one host, from its first start until it is closed.

`HostLoss` is one death of its worker, with its errors and what it means for the envs. `Supervisor`
decides what it means, and `Intake` carries it out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.hosts.base import Killable, SelfStarting
from rlightning_aio._core.hosts.limits import RestartPolicy, close_seconds, limits_of
from rlightning_aio.errors import EnvAway, EnvHung, WorkerDied
from rlightning_aio.registry import placement_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Host
    from rlightning_aio._core.hosts.messages import AttachOrder, Death, EnvStarted
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.outcomes import Loss
    from rlightning_aio.protocol.error_text import ErrorText


_FAULTS: Final[dict[str, type[WorkerDied | EnvAway]]] = {"env_hung": EnvHung, "env_away": EnvAway}
"""By the kind of an outcome; others are `WorkerDied`."""


class Stage(Enum):
    """The stage of a host in its life."""

    NEW = auto()
    BUILDING = auto()
    BUILT = auto()
    """Its envs are to get their rows."""
    UP = auto()
    DOWN = auto()
    """Dead, and to be restarted: at a given time, or for the next request."""
    REBUILDING = auto()
    """A replacement is starting."""
    CLOSING = auto()
    """All its envs are in the next worker."""
    CLOSED = auto()
    """It has no worker. Where the entry is recycled, one may be started."""


@dataclass(frozen=True, eq=False)
class HostLoss:
    """The loss of the states of a host's envs, described when it was found.

    Attributes:
        host_id, slots: of the host, and of the envs that it had.
        owed: its slots with a request in flight.
        death: of its worker, with the cause as the group knows it.
        replaced: a replacement is started, or a client awaited; else the error is raised, and the
            next request starts one.
        resets: the replacement may reset envs on its own; False of hardware, which only the user
            sets in motion.
        what: the subject and the cause; last: the last request of the env at fault.
        then: what happens to the worker now.
        env_ids: of all envs of the group, by slot.
        env_id: of the env at fault, or else of one that its errors name.
        why: what results report of the episodes that its envs have lost.
    """

    host_id: int
    slots: Sequence[int]
    owed: NDArray[np.intp]
    death: Death
    replaced: bool
    resets: bool
    what: str
    last: str
    then: str
    env_ids: Sequence[str]
    env_id: str
    why: Loss

    @property
    def message(self) -> str:
        """All that is known of it, in one line."""
        return self._message(self.owed)

    def error(self, owed: NDArray[np.intp]) -> WorkerDied | EnvAway:
        """The error of requests that were in flight, with the last lines of the worker's stderr."""
        return self._error(self._message(owed), owed)

    def refusal(self) -> WorkerDied | EnvAway:
        """The error for the next request, as no request was in flight that could end in it."""
        return self._error(f"{self.message}; nothing was sent", np.array(self.slots, np.intp))

    def _message(self, owed: NDArray[np.intp]) -> str:
        names = ", ".join(self._ids(owed)) or "none"
        return f"{self.what} ({self.last}; envs that owed a reply: {names}); {self.then}"

    def _error(self, message: str, slots: NDArray[np.intp]) -> WorkerDied | EnvAway:
        tail = self.death.stderr_tail
        error = fault_type(self.why)(message + last_lines(tail), env_id=self.env_id)
        if isinstance(error, WorkerDied):
            error.exit_code, error.stderr_tail = self.death.exit_code, tail
            error.env_ids = tuple(self._ids(slots))
        error.outcome = self.why.outcome(self.env_id)
        return error

    def _ids(self, slots: NDArray[np.intp]) -> list[str]:
        chosen: list[int] = slots.tolist()
        return [self.env_ids[slot] for slot in chosen]


@dataclass
class HostRecord:
    """The state of one host. Times are monotonic seconds.

    Attributes:
        started: its envs, once built.
        order: the rows of its envs, once assigned.
        start_by: the deadline of its start, or of its end while it is `CLOSING`; late: it missed
            that, and is being killed.
        traffic: see `Killable`, when `note_traffic` was last called.
        restart_at: the time of its next restart; restarts: the number so far.
        held: requests (entries and arguments) since its death, kept until a replacement is up.
        deaths: by slot, deaths of workers that this env is blamed for, and exceptions that it was
            restarted after, since it last completed a step; key None for deaths of unknown cause.
            A 0 counts none, but sets `Supervisor.any_deaths`, so that its times are looked at.
        culprit: the slot of the env that the last worker was executing when it died.
        dying: it was killed, and its exit was not reported yet; die_by: the end of the present half
            of its time for that; halves_left: those that have not begun.
        is_hung: its worker hung and is being killed.
        abort_by: by entry, when its worker is killed unless an aborted request has ended before;
            aborted_slot: of the env for whose request that is being done.
        idle: its progress when it was last seen idle, and idle_since the time (`HangDetector`).
        rebuild_error: the error of its replacement while rebuilding the envs.
        last_loss: its last death; launches: how often a worker of it was started.
        peer: the host that starts the next worker of the same envs; None unless they are recycled.
        is_next: its worker takes over the envs of the one in the peer, which goes on meanwhile.
        recycled: its workers that were replaced so; resident_mb: the most that one is known to
            have had; waits: resets that waited for the start of the next one.
        killable: the host, if it can be killed; place: the host, if its worker starts itself.
        was_shown: a place has shown a result.
        limits: the time limits of requests, by operation.
        timed: some of its requests have a time limit, which the supervisor watches.
        restart_policy: how many deaths in a row are borne; error_policy: how many exceptions.
        is_hardware: its envs move something real (of a place, the client that takes it says so).
        slots: of its envs; some may be in the peer's worker (`Tables.slots_of`).
    """

    host: Host
    config: EnvConfig
    stage: Stage = Stage.NEW
    started: list[EnvStarted] = field(default_factory=list["EnvStarted"])
    order: AttachOrder | None = None
    start_by: float | None = None
    late: bool = False
    traffic: int = 0
    restart_at: float | None = None
    restarts: int = 0
    held: list[tuple[NDArray[np.int64], Sequence[Any] | None]] = field(default_factory=list[Any])
    deaths: dict[int | None, int] = field(default_factory=dict[int | None, int])
    culprit: int | None = None
    dying: bool = False
    die_by: float = 0.0
    halves_left: int = 0
    is_hung: bool = False
    abort_by: dict[int, float] = field(default_factory=dict[int, float])
    aborted_slot: int | None = None
    idle: tuple[int, ...] = ()
    idle_since: float = 0.0
    rebuild_error: ErrorText | None = None
    last_loss: HostLoss | None = None
    launches: int = 0
    peer: HostRecord | None = field(default=None, repr=False)
    is_next: bool = False
    recycled: int = 0
    resident_mb: float = 0.0
    waits: int = 0
    killable: Killable | None = field(init=False)
    place: SelfStarting | None = field(init=False)
    was_shown: bool = False
    limits: dict[int, float] = field(init=False)
    timed: bool = field(init=False)
    restart_policy: RestartPolicy = field(init=False)
    error_policy: RestartPolicy = field(init=False)
    is_hardware: bool = field(init=False)
    slots: range = field(init=False)

    def __post_init__(self) -> None:
        self.killable = self.host if isinstance(self.host, Killable) else None
        self.place = self.host if isinstance(self.host, SelfStarting) else None
        self.limits = limits_of(self.config)
        self.timed = self.killable is not None and bool(self.limits)
        self.restart_policy = RestartPolicy(self.config, "on_worker_death")
        self.error_policy = RestartPolicy(self.config, "on_env_error")
        self.is_hardware = self.config.is_hardware
        self.slots = range(self.host.first_slot, self.host.first_slot + self.host.num_envs)

    @property
    def close_seconds(self) -> float:
        """Seconds that its worker may take to close its envs and to end."""
        return close_seconds(self.config, awaits=any(env.is_awaitable for env in self.started))

    @property
    def is_worker_here(self) -> bool:
        """Its envs are in a worker process of this machine."""
        place = placement_of(self.config.backend, self.config.placement)
        return self.killable is not None and place.local

    @property
    def is_down(self) -> bool:
        """Its worker has died, and its replacement is not up yet: it holds requests."""
        return self.stage in (Stage.DOWN, Stage.REBUILDING)

    @property
    def is_starting(self) -> bool:
        """It, or its replacement, is not up yet, and on its way."""
        return self.stage.value < Stage.UP.value or self.stage is Stage.REBUILDING

    @property
    def awaits_several(self) -> bool:
        """Its worker executes the requests of several envs at the same time."""
        return len(self.started) > 1 and any(env.is_awaitable for env in self.started)

    def drop_held(self, entries: NDArray[np.int64]) -> list[int]:
        """Take requests out of those that it holds; return the ones that it has held."""
        dropped: list[int] = []
        kept: list[tuple[NDArray[np.int64], Sequence[Any] | None]] = []
        for held, arguments in self.held:
            stays = ~np.isin(held, entries)
            own: list[int] = stays.nonzero()[0].tolist()
            if own:
                kept.append((held[stays], arguments and [arguments[k] for k in own]))
            dropped += held[~stays].tolist()
        self.held = kept
        return dropped

    def give_time(self, now: float) -> None:
        """Count the time of its start from now on, or that of its end."""
        is_ending = self.stage is Stage.CLOSING
        self.start_by = now + (self.close_seconds if is_ending else self.config.start_timeout)
        self.note_traffic()

    def note_traffic(self) -> bool:
        """Note what has passed between it and the trainer; True if that is more than last time."""
        before = self.traffic
        self.traffic = before if self.killable is None else self.killable.traffic
        return self.traffic != before

    def kill(self, *, dump: bool) -> None:
        """Kill its worker, if it has one; `dump` first writes the worker's stacks to stderr."""
        if self.killable is not None:
            self.killable.kill(dump=dump)


def fault_type(why: Loss) -> type[WorkerDied | EnvAway]:
    """Return the class of the error of an env that was lost."""
    return _FAULTS.get(why.kind, WorkerDied)


def last_lines(stderr_tail: str) -> str:
    """The end of a message: what a worker wrote at last."""
    lines = stderr_tail.strip().splitlines()[-25:]
    return ("\nThe last lines it wrote:\n  " + "\n  ".join(lines)) if lines else ""
