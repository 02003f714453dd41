"""The seam between the group's core and the places where envs live.

A *source* is something whose descriptor wakes a driver; a *host* is a source that
holds envs. Hosts tell the core what happened through an `Inbox`, and ask the driver
to watch their descriptors through a `Watcher`; neither side ever waits here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.errors import EnvFault
    from rlightning_aio.hosts.worker import AttachOrder, ErrorText, Started
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.protocol.net.server_session import ClientTraits
    from rlightning_aio.protocol.slab import Slab
    from rlightning_aio.types import EnvMeta

__all__ = ["Death", "Host", "Inbox", "Source", "Watcher"]


@dataclass(frozen=True)
class Death:
    """Why a worker is gone.

    Attributes:
        cause: one clause, such as "was killed by SIGKILL".
        exit_code: negative for a signal; None if nobody knows.
        stderr_tail: the last lines it wrote.
        hung: it was killed because an env ran into its timeout.
        requests: ring entries, those first that it may have been executing; they may be
            answered already, or be 0.
    """

    cause: str
    exit_code: int | None = None
    stderr_tail: str = ""
    hung: bool = False
    requests: tuple[int, ...] = ()


class Source(Protocol):
    """Something with a descriptor."""

    def fileno(self) -> int:
        """The descriptor to watch; level-triggered."""
        ...

    def on_readable(self) -> None:
        """Read what there is, without blocking; tell the inbox."""
        ...

    def on_writable(self) -> None:
        """Write what could not be written before, without blocking."""
        ...


class Watcher(Protocol):
    """What a driver does for sources.

    Attributes:
        shares_thread: other tasks may use the group while an operation waits.
    """

    shares_thread: bool

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


class Host(Source, Protocol):
    """Envs of one worker, numbered by row from 0.

    Attributes:
        host_id: position among the group's hosts.
        first_slot: the group's slot of row 0; the other rows follow.
        rows: envs here.
        in_flight: requests that are not answered yet.
        ordered: results after which it will wake us next; 0 if nothing was ordered.
        inline: its requests are executed by `run_one`, not by themselves.
        elastic: its envs come and go, so it may tell of results that nobody asked for.
    """

    host_id: int
    first_slot: int
    rows: int
    in_flight: int
    ordered: int
    inline: bool
    elastic: bool

    def start(self) -> None:
        """Begin to build the envs; `Inbox.on_started` or `Inbox.on_start_error` follows."""
        ...

    def attach(self, order: AttachOrder) -> None:
        """Give the envs their rows; `Inbox.on_attached` follows."""
        ...

    def request(self, entries: NDArray[np.int64]) -> None:
        """Send numbered requests whose arguments lie in the rows."""
        ...

    def pack(self, content: Any) -> Any:
        """`content` as the requests below send it; nobody's later change reaches it.

        Raises whatever makes it impossible to send, which is why it comes before anything is.
        """
        ...

    def request_step(self, row: int, number: int, packed: Any) -> None:
        """Send a step whose arguments don't fit the row: (action, extras)."""
        ...

    def request_reset(self, row: int, number: int, packed: Any) -> None:
        """Send a reset with options: (seed, options)."""
        ...

    def request_call(self, row: int, number: int, packed: Any) -> None:
        """Send a method call: (name, args, kwargs)."""
        ...

    def order(self, count: int) -> bool:
        """Ask to be woken when `count` results are ready; True if they already are."""
        ...

    def withdraw(self) -> None:
        """Take the last `order` back: the caller looks for results itself."""
        ...

    def unread(self) -> int:
        """Results that wait to be swept; costs a look into memory."""
        ...

    def sweep(self) -> None:
        """Tell the inbox of results that came without a wake-up."""
        ...

    def run_one(self) -> bool:
        """Execute one waiting request here and now (inline placement); False if none waits."""
        ...

    def executing(self) -> tuple[int, int]:
        """Entry being executed and since when (monotonic ns); entry 0 if none."""
        ...

    def kill(self, *, dump: bool) -> None:
        """End the worker; `Inbox.on_death` follows."""
        ...

    def close(self) -> None:
        """Ask the envs to close; `Inbox.on_closed` follows."""
        ...

    def release(self) -> None:
        """Give descriptors back; nothing follows."""
        ...


class Inbox(Protocol):
    """What hosts tell the core."""

    def on_started(self, host: Host, started: list[Started]) -> None:
        """The envs are built."""
        ...

    def on_start_error(self, host: Host, row: int, error: ErrorText) -> None:
        """Env `row` could not be built."""
        ...

    def on_attached(self, host: Host) -> None:
        """The envs can be asked."""
        ...

    def on_reports(self, entries: NDArray[np.int64]) -> None:
        """These requests are done, and their results lie in the rows."""
        ...

    def on_rest(self, host: Host, row: int, number: int, rest: bytes | dict[str, Any]) -> None:
        """A request is done, and `rest` (a pickle, or plain) goes with its row."""
        ...

    def on_value(self, host: Host, row: int, number: int, value: Any) -> None:
        """A call has returned."""
        ...

    def on_error(self, host: Host, row: int, number: int, error: ErrorText) -> None:
        """A request has raised."""
        ...

    def on_slab(self, host: Host, slab: Slab) -> None:
        """The envs of an elastic host have rows from now on: those of `slab`."""
        ...

    def on_client(self, host: Host, row: int, meta: EnvMeta, traits: ClientTraits) -> int:
        """An env has joined, and its first result follows; the entry of what that answers."""
        ...

    def is_idle(self, host: Host, row: int) -> bool:
        """Whether nothing was asked of an env, and nothing of it waits to be collected."""
        ...

    def on_withdrawn(self, host: Host, row: int, number: int) -> None:
        """A request will not be answered: its env is away, and the caller was told so."""
        ...

    def on_fault(self, host: Host, row: int, number: int, fault: EnvFault) -> None:
        """A request has ended in an error that is known as such."""
        ...

    def on_schema(self, host: Host, number: int, schema: InfoSchema) -> None:
        """The worker holds infos in one more way."""
        ...

    def on_death(self, host: Host, death: Death) -> None:
        """The worker is gone, without having been asked to close."""
        ...

    def on_closed(self, host: Host, errors: list[tuple[int, ErrorText]]) -> None:
        """The worker has closed and is gone; `errors` are those of the envs' `close`."""
        ...
