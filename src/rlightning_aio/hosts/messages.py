"""What crosses between a trainer and the places where its envs live.

Orders go one way, completions come back: each completion says what has become of one
request, or of a host, and hosts append them to their group's one queue, in order, whatever
thread of events they come from. What of a request or a result has no place in a row
travels *out of band*.
Absent on purpose: how these travel (see `link`), and what they mean (see `group.core`).
"""

from __future__ import annotations

import os
import traceback
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.errors import EnvFault
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.protocol.slab import RowLayout, Slab
    from rlightning_aio.types import ClientTraits, EnvMeta

__all__ = [
    "NO_ACTION",
    "RECORD_VIDEO",
    "AttachOrder",
    "Attached",
    "Built",
    "Closed",
    "Completion",
    "Completions",
    "Death",
    "Died",
    "EnvStarted",
    "ErrorText",
    "Failed",
    "Joined",
    "NewSchema",
    "NotBuilt",
    "OutOfBand",
    "Raised",
    "Reported",
    "Result",
    "Saved",
    "StartOrder",
    "Value",
    "Withdrawn",
    "WorkerPlace",
]

NO_ACTION: Final = "the action is in the row"
"""Travels in place of an action whose extras alone go out of band."""
RECORD_VIDEO: Final = "rlightning_aio.record_video"
"""A call of this name is for the runner, not for its env, none of whose methods is called so."""
OutOfBand: TypeAlias = dict[str, Any]
"""What of a result has no place in its row. Keys: ``observation``, ``info``, ``extra`` (the
result's ``_extra``), ``ret`` (all of it)."""


# -- orders -----------------------------------------------------------------------


@dataclass(frozen=True)
class StartOrder:
    """What a host is to build; travels by cloudpickle.

    Attributes:
        config: the entry.
        env_class: the class itself where it was registered in the trainer by hand;
            None resolves the entry's backend where the env is built.
        worker_indices: which envs of the entry.
        preprocess_fns: one for each of them; None for the default.
        spins: whether waiting may burn a core for some microseconds.
        core: the core to stay on; None for any.
        trainer_pid: the process that gives the order; None where it runs on another machine.
        tasks: of `known_tasks`.
    """

    config: EnvConfig
    env_class: type[BaseEnv] | None
    worker_indices: tuple[int, ...]
    preprocess_fns: tuple[Any, ...]
    spins: bool
    core: int | None
    trainer_pid: int | None = field(default_factory=os.getpid)
    tasks: tuple[bytes, ...] = ()


@dataclass(frozen=True)
class AttachOrder:
    """Where a host's envs write. What a row consists of, each of them knows by itself.

    Attributes:
        slabs: offset in the arena and number of rows of each slab of the group.
        rows: for each env which slab and which row of it.
        standings: where envs of a replacement are to stand, see `Saved`; None for one that
            begins anew. Empty where all do.
    """

    slabs: tuple[tuple[int, int], ...]
    rows: tuple[tuple[int, int], ...]
    standings: tuple[bytes | None, ...] = ()


@dataclass(frozen=True)
class WorkerPlace:
    """Where a worker finds its part of the group's shared memory.

    Attributes:
        host_id: which of the group's `num_hosts` hosts it belongs to.
        first_slot, num_envs: slots of its envs.
        bell_offset, rings_offset: in the arena.
    """

    host_id: int
    num_hosts: int
    first_slot: int
    num_envs: int
    bell_offset: int
    rings_offset: int


# -- what comes back --------------------------------------------------------------


@dataclass(frozen=True)
class EnvStarted:
    """What is known of an env once it is built."""

    meta: EnvMeta
    layout: RowLayout
    reads_extras: bool
    transforms_actions: bool


@dataclass(frozen=True)
class ErrorText:
    """An exception as text: it crosses processes whatever its class is like."""

    type_name: str
    text: str
    traceback: str

    @property
    def summary(self) -> str:
        """The last line of the traceback: its type and, where it has one, its text."""
        return f"{self.type_name}: {self.text}" if self.text else self.type_name

    @classmethod
    def of(cls, error: BaseException) -> ErrorText:
        """`error` in words, in plain text; nothing about its class is an obstacle."""
        kind = type(error)
        name = _plain(_NAME.__get__(kind))
        module = _MODULE.__get__(kind)
        if isinstance(module, str) and module != "builtins":
            name = f"{_plain(module)}.{name}"
        try:
            text = _plain(str(error))
        except BaseException as broken:
            text = f"<its __str__ raised {_plain(_NAME.__get__(type(broken)))}>"
        try:
            lines = _plain("".join(traceback.format_exception(error)))
        except BaseException:
            # As it was noted when it was raised, whatever its class says.
            frames = traceback.format_tb(_TRACEBACK.__get__(error))
            lines = "".join(frames) + f"{name}: {text}\n"
        return cls(name, text, lines)


_NAME: Final[Any] = vars(type)["__qualname__"]
_MODULE: Final[Any] = vars(type)["__module__"]
_TRACEBACK: Final[Any] = vars(BaseException)["__traceback__"]
"""What a class may have redefined, as Python itself defines it."""


def _plain(text: str) -> str:
    """`text` as a `str` and nothing else: a subclass may be unknown elsewhere."""
    return str.__str__(text)


@dataclass(frozen=True)
class Death:
    """Why a worker is gone.

    Attributes:
        cause: one clause, such as "was killed by SIGKILL".
        exit_code: negative for a signal; None if nobody knows.
        stderr_tail: the last lines it wrote.
        requests: entries, those first that it may have been executing; they may be
            answered already, or be 0.
    """

    cause: str
    exit_code: int | None = None
    stderr_tail: str = ""
    requests: tuple[int, ...] = ()


class Built(NamedTuple):
    """The host's envs are built."""

    host_id: int
    started: list[EnvStarted]


class NotBuilt(NamedTuple):
    """The env of index `env_index` could not be built."""

    host_id: int
    env_index: int
    error: ErrorText


class Attached(NamedTuple):
    """The host's envs have their rows, and can be asked."""

    host_id: int


class Died(NamedTuple):
    """The worker is gone, without having been asked to close."""

    host_id: int
    death: Death


class Closed(NamedTuple):
    """The host has closed and is gone; `errors` are those of the envs' `close`, by index."""

    host_id: int
    errors: list[tuple[int, ErrorText]]


class NewSchema(NamedTuple):
    """The host holds infos in one more way."""

    host_id: int
    number: int
    schema: InfoSchema


class Saved(NamedTuple):
    """An env has given its standing away: its state, and what it shows.

    Attributes:
        standing: a pickle that none but a worker reads.
        before: it is from before the request that is being executed, and not from after.
    """

    host_id: int
    env_index: int
    standing: bytes
    before: bool


class Reported(NamedTuple):
    """These requests to one host are done, and their results lie in the rows."""

    host_id: int
    entries: NDArray[np.int64]


class Result(NamedTuple):
    """A request is done; `out_of_band` (a pickle, or plain) goes with its row.

    Attributes:
        is_loss: no result of the env's, but the mark that it is gone.
    """

    host_id: int
    entry: int
    out_of_band: bytes | OutOfBand
    is_loss: bool = False


class Value(NamedTuple):
    """A call has returned."""

    host_id: int
    entry: int
    value: Any


class Raised(NamedTuple):
    """A request has raised."""

    host_id: int
    entry: int
    error: ErrorText


class Failed(NamedTuple):
    """A request has ended in an error that is known as such."""

    host_id: int
    entry: int
    fault: EnvFault


class Withdrawn(NamedTuple):
    """A request will not be answered: its env is away, and the caller was told so."""

    host_id: int
    entry: int


class Joined(NamedTuple):
    """An env has come by itself, with a first result that nobody has asked for.

    Attributes:
        env_index: its index in the host.
        slab: where the host's envs have their rows from now on; None if that is known.
        write: puts the result into its row, which may hold one that nobody has collected
            yet; returns what of it is out of band.
    """

    host_id: int
    env_index: int
    meta: EnvMeta
    traits: ClientTraits
    slab: Slab | None
    write: Callable[[], OutOfBand | None]


Completion: TypeAlias = (
    Built | NotBuilt | Attached | Died | Closed | NewSchema
    | Saved | Reported | Result | Value | Raised | Failed | Withdrawn | Joined
)  # fmt: skip
Completions: TypeAlias = deque[Completion]
"""A group's queue: every host appends, the core takes out."""
