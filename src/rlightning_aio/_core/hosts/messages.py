"""Messages between a trainer and its hosts.

Orders go to hosts, completions come back. Each completion reports the outcome of one request, or
an event of a host. Hosts append them in order to the one queue of their group. Data of a request or
a result that has no place in a row travels *out of band*.
Left out on purpose: transport, which each host has its own of, and the effects of messages (see
`engine.intake`).
"""

from __future__ import annotations

import os
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.logs import LogSettings
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.outcomes import Loss
    from rlightning_aio.protocol.error_text import ErrorText
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.protocol.slab import RowLayout, Slab
    from rlightning_aio.types import EnvMeta

STEP_IN_ROW: Final[tuple[Any, dict[str, Any]]] = (None, {})
"""The action and the extras of a step that has no arguments out of band."""
OutOfBand: TypeAlias = dict[str, Any]
"""The part of a result that has no place in its row. Keys: ``observation``, ``info``, ``extra``
(the result's ``_extra``)."""


# -- orders -----------------------------------------------------------------------


class EnvState(NamedTuple):
    """The value of a request for a snapshot.

    Attributes:
        versions: of the libraries that the state is of.
        state: of the env with its last result; None if it was never reset.
    """

    versions: dict[str, str]
    state: bytes | None


@dataclass(frozen=True)
class StartOrder:
    """The envs that a host must build; travels by cloudpickle.

    Attributes:
        config: the entry.
        env_class: a class that was registered in the trainer; None resolves the backend of the
            entry where the env is built.
        worker_indices: of the envs in the entry.
        preprocess_fns: one for each env; None for the default.
        spins: waiting may use a core for some microseconds.
        trainer_pid: the process that gives the order; None if it runs on another machine.
        tasks: of `known_tasks`.
        is_hardware: the envs move something real.
        logs: how a worker logs; None for Python's own way.
        is_again: the envs take the place of others that were made before.
    """

    config: EnvConfig
    env_class: type[BaseEnv] | None
    worker_indices: tuple[int, ...]
    preprocess_fns: tuple[Any, ...]
    spins: bool
    trainer_pid: int | None = field(default_factory=os.getpid)
    tasks: tuple[bytes, ...] = ()
    is_hardware: bool = False
    logs: LogSettings | None = None
    is_again: bool = False


@dataclass(frozen=True)
class AttachOrder:
    """The rows of the envs of a host. Each env knows the layout of its row.

    Attributes:
        slabs: offset in the arena and number of rows of each slab of the group.
        rows: index of the slab, and the row in it, for each env.
        close_seconds: how long the host may take to close, see `limits.close_seconds`.
    """

    slabs: tuple[tuple[int, int], ...]
    rows: tuple[tuple[int, int], ...]
    close_seconds: float


@dataclass(frozen=True)
class WorkerPlace:
    """The part of the shared memory that belongs to a worker; no place of an env_server.

    Attributes:
        host_id: of its host, one of `num_hosts`.
        first_slot, num_envs: slots of its envs.
        bell_offset, rings_offset: in the arena.
    """

    host_id: int
    num_hosts: int
    first_slot: int
    num_envs: int
    bell_offset: int
    rings_offset: int


# -- completions ------------------------------------------------------------------


@dataclass(frozen=True)
class EnvStarted:
    """The description of an env that was built.

    Attributes:
        reads_extras: extras of responses are sent to it.
        actions_beside_row: its actions travel in the channel and not in its row.
        is_awaitable: its host executes its requests together with those of others.
    """

    meta: EnvMeta
    layout: RowLayout
    reads_extras: bool
    actions_beside_row: bool
    is_awaitable: bool = False


@dataclass(frozen=True)
class Death:
    """The end of a worker.

    Attributes:
        cause: one clause, such as "was killed by SIGKILL".
        exit_code: negative for a signal; None if unknown.
        stderr_tail: the end of what it wrote to stdout and then of what it wrote to stderr.
        requests: entries, beginning with those that it may have been executing; they may be
            answered already, or be 0. Where envs are awaitable, the first is the one whose code
            ran, or 0 if all envs waited.
        refused: the system did not let it start; with_server: its fork server has ended.
        in_order: it was a client that said goodbye, which is no fault.
    """

    cause: str
    exit_code: int | None = None
    stderr_tail: str = ""
    requests: tuple[int, ...] = ()
    refused: bool = False
    with_server: bool = False
    in_order: bool = False


class Built(NamedTuple):
    """The envs of the host are built."""

    host_id: int
    started: list[EnvStarted]


class NotBuilt(NamedTuple):
    """The env of index `env_index` could not be built."""

    host_id: int
    env_index: int
    error: ErrorText


class Attached(NamedTuple):
    """The envs of the host have their rows and accept requests."""

    host_id: int


class Died(NamedTuple):
    """The worker ended without a request to close."""

    host_id: int
    death: Death


class Closed(NamedTuple):
    """The host has closed; `errors` are (index, error) of envs whose `close` raised."""

    host_id: int
    errors: list[tuple[int, ErrorText]]


class NewSchema(NamedTuple):
    """The host will write infos in a new layout."""

    host_id: int
    number: int
    schema: InfoSchema


class Reported(NamedTuple):
    """Requests to one host are done, and the rows hold their whole results."""

    host_id: int
    entries: NDArray[np.int64]


class Result(NamedTuple):
    """A request is done; `out_of_band` (a pickle, or an object) completes its row."""

    host_id: int
    entry: int
    out_of_band: bytes | OutOfBand


class Value(NamedTuple):
    """A call has returned."""

    host_id: int
    entry: int
    value: Any


class Raised(NamedTuple):
    """A request has raised, or was aborted before it has begun."""

    host_id: int
    entry: int
    error: ErrorText


class Lost(NamedTuple):
    """One env of a host that goes on is gone; the next request makes another.

    Attributes:
        entry: of the request that it leaves without an answer; 0 if it was idle.
        message: what has happened to it, for an error.
        answered: entry of the last request that it has answered; 0 if there was none.
    """

    host_id: int
    env_index: int
    why: Loss
    entry: int = 0
    message: str = ""
    answered: int = 0


class Moved(NamedTuple):
    """A reset was not executed, as the worker is renewed (`EnvConfig.recycle`).

    Attributes:
        entry: of the reset.
        arguments: packed, of the same reset in the next worker, or in this one.
        is_due: the next worker executes it, if there is one; else that is only to be started.
        resident_mb: memory of the worker.
    """

    host_id: int
    entry: int
    arguments: bytes
    is_due: bool
    resident_mb: float


class Taken(NamedTuple):
    """A client has dialled in, so the host accepts requests.

    Attributes:
        started: the client's env.
        is_hardware: it moves something real.
        slab: of all places of the entry, if this is its first client.
        first_slot: of the entry's places.
    """

    host_id: int
    started: EnvStarted
    is_hardware: bool
    slab: Slab | None
    first_slot: int


Completion: TypeAlias = (
    Built | NotBuilt | Attached | Died | Closed | NewSchema
    | Reported | Result | Value | Raised | Lost | Moved | Taken
)  # fmt: skip
Completions: TypeAlias = deque[Completion]
"""The queue of a group: hosts append, the core removes."""
