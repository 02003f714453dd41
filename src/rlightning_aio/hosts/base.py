"""The seam between a group's core and the places where envs live.

A `Host` starts, is asked, and ends; what becomes of that it appends to its group's queue
of completions (see `messages`). Beyond that a host does only what it can: one with a
descriptor is a `Source`, one whose results may lie there unnoticed is `Polled`, one that
executes in the caller's thread is `Executing`, and one whose envs come and go has
`Membership`. The core asks what a host can do, never what it is.
Absent on purpose: waiting. Neither side ever does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.hosts.arena import Arena
    from rlightning_aio.hosts.messages import AttachOrder, Completions, StartOrder
    from rlightning_aio.protocol.bell import TrainerBell
    from rlightning_aio.types import EnvMeta

__all__ = [
    "Executing",
    "Host",
    "HostFactory",
    "Killable",
    "Membership",
    "Polled",
    "Source",
    "Watcher",
    "Wiring",
]


class Source(Protocol):
    """Something with a descriptor, which stays the same while it is watched."""

    def fileno(self) -> int:
        """The descriptor to watch; level-triggered."""
        ...

    def on_readable(self) -> None:
        """Read what there is, without blocking; append what it means to the completions."""
        ...

    def on_writable(self) -> None:
        """Write what could not be written before, without blocking."""
        ...


class Watcher(Protocol):
    """What a driver does for sources."""

    def watch(self, source: Source) -> None:
        """Call `source.on_readable` whenever its descriptor is readable, from now on."""
        ...

    def unwatch(self, source: Source) -> None:
        """Forget `source`; call it before its descriptor is closed."""
        ...

    def watch_writable(self, source: Source, wanted: bool) -> None:
        """Also call `source.on_writable` whenever its descriptor is writable."""
        ...

    def wake(self) -> None:
        """Have every operation that waits look again, as if a source had told something."""
        ...


class Host(Protocol):
    """Envs that live in one place, numbered by index from 0.

    Attributes:
        host_id: position among the group's hosts.
        first_slot: the group's slot of index 0; the other envs follow.
        num_envs: envs here, or places for them.
    """

    host_id: int
    first_slot: int
    num_envs: int

    def start(self) -> None:
        """Begin to build the envs; `Built` or `NotBuilt` follows, or `Died`.

        Called again after `Died`, for a replacement.

        Raises:
            OSError: no place for them can be made.
        """
        ...

    def attach(self, order: AttachOrder) -> None:
        """Give the envs their rows; `Attached` follows.

        For a replacement it comes before the envs are built, with the rows of the first time.
        """
        ...

    def packed(self, arguments: Any) -> Any:
        """`arguments` as `submit` sends them; nobody's later change reaches them.

        Args:
            arguments: what goes out of band: (action, extras), (seed, options) or (name, args,
                kwargs).

        Raises what makes it impossible to send them: so it is called before anything is sent.
        """
        ...

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        """Send requests, which their entries name (see `protocol.entries`).

        Args:
            entries: env, number and operation of each.
            arguments: packed, one for each: (action, extras) of a step, (seed, options) of a
                reset, (name, args, kwargs) of a call. None: they lie in the rows.

        One completion follows for each: `Reported`, `Result`, `Value`, `Raised`, `Failed` or
        `Withdrawn`, with the same entry; or the host's `Died` for all.
        """
        ...

    def close(self) -> None:
        """Ask the envs to close, after what they still execute; `Closed` follows."""
        ...

    def release(self) -> None:
        """Give descriptors and memory back, at once; nothing follows. Idempotent."""
        ...


@runtime_checkable
class Killable(Protocol):
    """A host that can hang, and be ended by force."""

    def executing(self) -> tuple[int, int]:
        """Entry being executed and since when (monotonic ns); entry 0 if none.

        The time is 0 while it waits for the trainer to read what has come of the entry so far.
        """
        ...

    @property
    def traffic(self) -> int:
        """Changes whenever a part of a reply has been read, or more of a request been written."""
        ...

    def catch_up(self) -> bool:
        """Take in what it has told, and write what it is to be told, without blocking; whether
        there was anything.

        Called before it is ended by force: the trainer may be the one that is late.
        """
        ...

    def kill(self, *, dump: bool) -> None:
        """End it; `Died` follows. With `dump`, have it write its stacks first."""
        ...

    def destroy(self) -> None:
        """End it together with what it stands on, when `kill` has not ended it; `Died` follows,
        also of other hosts that stand on the same.
        """
        ...


@runtime_checkable
class Polled(Protocol):
    """A host some of whose results wake nobody."""

    def poll(self) -> None:
        """Append what lies there to the completions, without blocking."""
        ...


@runtime_checkable
class Executing(Protocol):
    """A host that executes requests where it is asked to."""

    def execute_next(self) -> bool:
        """Execute one waiting request here and now; False if none waits.

        What has come of it is among the completions after `poll`.
        """
        ...

    def poll(self) -> None:
        """See `Polled.poll`."""
        ...


@runtime_checkable
class Membership(Protocol):
    """A host whose envs come and go, and answer when they can (an env_server).

    Its results come unasked, too (`Joined`), and wake the driver by themselves.

    Attributes:
        server_id: what a batch calls its envs.
    """

    server_id: str

    def address(self) -> str:
        """Where its envs connect to, as ``tcp://host:port``.

        Raises:
            RuntimeError: it does not listen yet.
        """
        ...

    def members(self) -> Mapping[str, EnvMeta]:
        """The envs that are here, by the name of their client."""
        ...

    def member_indices(self) -> list[int]:
        """Indices of the envs that are here, in the order of their names."""
        ...

    def num_sub_envs(self, index: int) -> int:
        """Sub-environments of an env that is here."""
        ...

    def check_step(self, index: int, action: Any, extras: dict[str, Any]) -> None:
        """Raises `BadAction` if an env can't be sent these; `NO_ACTION` means the row's."""
        ...

    def check_reset(self, index: int, seed: int | None, options: dict[str, Any]) -> None:
        """Raises ValueError if an env can't be sent these."""
        ...

    def missing(self, waited: float) -> float | None:
        """How long a reset may wait in all for envs that are missing; None if none are.

        Args:
            waited: seconds that it has waited already.

        Raises:
            TimeoutError: it has waited longer than that.
        """
        ...

    def poll(self) -> None:
        """See `Polled.poll`."""
        ...

    def is_readable(self) -> bool:
        """Whether anything has come that `tick` would take in."""
        ...

    def deadline(self) -> float | None:
        """When `tick` is due at the latest (monotonic seconds); None if it need not come."""
        ...

    def tick(self, now: float) -> None:
        """Take in what has come; find those that are gone. `now` is monotonic seconds."""
        ...


@dataclass(frozen=True)
class Wiring:
    """What a group gives its hosts.

    Attributes:
        completions: where a host says what has become of requests.
        watcher: the driver.
        arena: shared memory; bell: how workers wake the trainer, and where it lies there.
        num_hosts: of the group.
        configs: all entries.
        objection: why an env that comes by itself may not join, if there is a reason.
        is_idle: whether nothing was asked of a slot and nothing of it waits to be collected.
        resources: what hosts of one kind share, made by the first of them; ended with
            `release(seconds)` after the hosts.
    """

    completions: Completions
    watcher: Watcher
    arena: Arena
    bell: TrainerBell
    bell_offset: int
    num_hosts: int
    configs: Sequence[EnvConfig]
    objection: Callable[[EnvMeta], str | None]
    is_idle: Callable[[int], bool]
    resources: dict[object, Shared]


class Shared(Protocol):
    """What several hosts use, and none of them ends."""

    def release(self, seconds: float) -> None:
        """Let go of it; what it still does may take `seconds`, and is then ended by force."""
        ...

    def disown(self) -> None:
        """Let go of this process's share: it was forked, and the other one goes on using it."""
        ...


class HostFactory(Protocol):
    """How a host is made: its class, for all that the group knows."""

    def __call__(
        self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring
    ) -> Host: ...
