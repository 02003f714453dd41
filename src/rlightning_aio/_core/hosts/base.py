"""The seam between the core of a group and the places that run envs.

A `Host` starts, accepts requests, and ends. It reports everything by completions, which it appends
to the queue of its group (see `messages`). What only some hosts can do has a default there, which
does nothing. Three more protocols are optional: a host that can hang is `Killable`, one that
executes in the thread of the caller is `Executing`, and one whose worker starts itself is
`SelfStarting`. The core checks for these, never for a class of hosts. A host with a descriptor has
the driver watch it, or a part of it, as a `Source`.
Left out on purpose: waiting. Neither side ever waits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.arena import Arena
    from rlightning_aio._core.hosts.messages import AttachOrder, Completions
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.protocol.exchange import Ring
    from rlightning_aio.protocol.net.server_session import ServerSessions
    from rlightning_aio.protocol.rings import TrainerBell
    from rlightning_aio.types import EnvMeta

T = TypeVar("T")


class Source(Protocol):
    """An object with a descriptor, which stays the same while it is watched."""

    def fileno(self) -> int:
        """The descriptor to watch; level-triggered."""
        ...

    def on_readable(self) -> None:
        """Read without blocking, and append completions."""
        ...

    def on_writable(self) -> None:
        """Write pending data without blocking."""
        ...


class Driver(Protocol):
    """The part of a driver that watches sources."""

    def watch(self, source: Source) -> None:
        """Call `source.on_readable` whenever its descriptor is readable."""
        ...

    def unwatch(self, source: Source) -> None:
        """Forget `source`; call it before its descriptor is closed."""
        ...

    def watch_writable(self, source: Source, wanted: bool) -> None:
        """Also call `source.on_writable` whenever its descriptor is writable."""
        ...

    def wake(self) -> None:
        """Wake the calls that wait for sources, as if one had posted a completion."""
        ...

    def read(self) -> None:
        """Read what sources have received, without waiting, if no event loop does so anyway."""
        ...

    def interruptible(self, execute: Callable[[], T]) -> T:
        """Call a function that runs an env; Ctrl-C may interrupt it."""
        ...

    def others(self, held: object) -> str:
        """Return a clause on the other tasks whose calls hold an object, if there are any."""
        ...


class Host(Protocol):
    """Envs in one place, with indices from 0.

    Attributes:
        host_id: its index among the hosts of the group.
        first_slot: slot of the env of index 0; the other envs follow.
        num_envs: the most envs it can have.
        on_bell: it counts its results on the group's bell, and `poll` appends them.
        needs_loop: its envs make progress only while the driver waits in its event loop.
    """

    host_id: int
    first_slot: int
    num_envs: int
    on_bell: bool = False
    needs_loop: bool = False

    def start(self) -> None:
        """Begin to build the envs; `Built` or `NotBuilt` follows, or `Died`.

        Called again after `Died`, for a replacement, or after `Closed`, if the entry is recycled.

        Raises:
            OSError: the system refuses to start one.
        """
        ...

    def attach(self, order: AttachOrder) -> None:
        """Give the envs their rows; `Attached` follows.

        A replacement gets this order before its envs are built, with the same rows as before.
        """
        ...

    def packed(self, arguments: Any) -> Any:
        """Return `arguments` in the form that `submit` sends; later changes don't affect it.

        Args:
            arguments: out of band, as of `submit`.

        Raises if they can't be sent. So callers pack all arguments before they send a request.
        """
        ...

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        """Send requests.

        Args:
            entries: env, number and operation of each request (see `protocol.entries`).
            arguments: packed, one for each: (action, extras) of a step, with None for an action
                that is in the row; (seed, options) of a reset, (name, args, kwargs) of a call,
                (versions, state) of a restore. None: they are in the rows.

        One completion follows for each: `Reported`, `Result`, `Value`, `Raised`, `Lost` or `Moved`,
        with the same entry; or the host's `Died` for all.
        """
        ...

    def close(self) -> None:
        """Close the envs after their current requests; `Closed` follows."""
        ...

    def release(self) -> None:
        """Release descriptors and memory immediately; no completion follows. Idempotent."""
        ...

    # -- what only some hosts can do --------------------------------------------------

    def poll(self) -> None:
        """Append completions of finished requests, without blocking."""

    def abort(self, entries: NDArray[np.int64]) -> None:
        """End requests soon, without blocking or harm to other envs, as far as that is possible.

        Args:
            entries: of requests, which may have ended already.

        One completion follows for each, as for any request, when nothing of it goes on in its env;
        nobody uses what it holds.
        """

    def stop(self, index: int, number: int) -> None:
        """Stop what an env moves, at once, even while it executes a request.

        Args:
            index: of the env, which is hardware, in this host.
            number: of its current or last request; later ones may move it again.

        An actor of Ray can't, so the config refuses hardware there.
        """

    def resident_mb(self) -> float:
        """Return the resident memory of its worker and its descendants; 0 if it isn't known."""
        return 0.0

    def processor_ns(self) -> int | None:
        """Return for how long its living threads have run or waited for a core, if known."""
        return None


@runtime_checkable
class Killable(Protocol):
    """A host that can hang, and that can be killed."""

    def current_request(self) -> tuple[int, int]:
        """Return the entry being executed and its start (monotonic ns); entry 0 if none.

        The start is 0 while the worker waits for the trainer to read a reply.
        """
        ...

    @property
    def traffic(self) -> int:
        """A number that changes whenever a part of a reply is read, or of a request is written."""
        ...

    def catch_up(self) -> bool:
        """Read pending replies and write pending requests, without blocking.

        Returns True if anything moved. Called before a host is killed, because the trainer may be
        the one that is late.
        """
        ...

    def kill(self, *, dump: bool) -> None:
        """Kill it; `Died` follows. With `dump`, it writes its stacks first."""
        ...

    def destroy(self) -> None:
        """Kill it and the process that it depends on, if `kill` had no effect.

        `Died` follows, also for other hosts that depend on that process.
        """
        ...


@runtime_checkable
class Executing(Protocol):
    """A host that executes requests in the thread of the caller."""

    def execute(self, most: int, is_over: Callable[[], bool] | None) -> int:
        """Execute up to `most` waiting requests, and append their completions.

        `is_over` is asked after each, and ends it, too. Returns how many it has executed.
        """
        ...


class Server(Protocol):
    """The one listener of several hosts that start themselves.

    Attributes:
        server_id: the id of the entry as a whole.
        connect_timeout: seconds that a call waits for such hosts alone.
        sessions: of the clients that are there.
    """

    server_id: str
    connect_timeout: float
    sessions: ServerSessions

    def address(self) -> str:
        """Return the address that clients connect to, as ``tcp://host:port``.

        Raises:
            RuntimeError: it does not listen yet.
        """
        ...

    def is_readable(self) -> bool:
        """Return True if `poll` would read anything."""
        ...

    def poll(self) -> None:
        """Read what clients sent, without blocking."""
        ...


@runtime_checkable
class SelfStarting(Host, Protocol):
    """A host whose worker starts itself: a place of an env_server, for a client that dials in.

    It has one env. It posts `Taken` when somebody has dialled in, and `Died` when that one is gone.
    Between them, and at no other time, it accepts requests; the first one is a reset.

    Attributes:
        server: shared with the other places.
        env_id: of its env.
        client: name of the client that is there; empty if none is.
    """

    server: Server

    @property
    def env_id(self) -> str: ...

    @property
    def client(self) -> str: ...

    def admit(self) -> None:
        """Note that the group has applied a `Taken`: what it submits now is for that client."""
        ...

    def drop_reset(self) -> None:
        """Don't repeat the reset that was lost with the last client."""
        ...

    def check_step(self, action: Any, extras: dict[str, Any]) -> None:
        """Raise `BadAction` if a step can't be sent; the action may be in the row."""
        ...

    def check_reset(self, seed: int | None, options: dict[str, Any] | None) -> None:
        """Raise `ValueError` if a reset can't be sent."""
        ...


@dataclass(frozen=True)
class Wiring:
    """The parts of a group that its hosts use.

    Attributes:
        completions: the queue.
        driver: of the group.
        arena: the shared memory.
        bell, bell_offset: workers wake the trainer by it; its offset in the arena.
        rings: by host, those of live workers.
        num_hosts: of the group.
        configs: all entries.
        objection: returns the reason why an env that a client brings is refused, or None.
        busy_since: when the request was sent that a slot has not answered; None if it has.
        resources: shared by hosts of one kind, and made by the first of them; released by
            `release(seconds)` after the hosts.
    """

    completions: Completions
    driver: Driver
    arena: Arena
    bell: TrainerBell
    bell_offset: int
    rings: list[Ring | None]
    num_hosts: int
    configs: Sequence[EnvConfig]
    objection: Callable[[EnvMeta], str | None]
    busy_since: Callable[[int], float | None]
    resources: dict[object, Shared]


class Shared(Protocol):
    """A resource that several hosts share."""

    def release(self, seconds: float) -> None:
        """End it; kill what is still running after `seconds`."""
        ...

    def disown(self) -> None:
        """Drop it in a forked process; the parent continues to use it.

        Nothing is to be done where it belongs to threads, which only the parent has.
        """
