"""`RayHost`: envs in a Ray actor, on any node of the cluster that has room for it.

One remote call carries a batch of requests, with one array for each column, and its reply has the
same form. Threads of Ray put outcomes into an `Inbox`, whose descriptor wakes the trainer. A node
that dies is a worker that dies, and its replacement is another actor.
Rule: no other module of the package imports Ray. Only connecting to a cluster blocks, once.
Left out on purpose: the execution of requests (see `actor`).
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rlightning_aio._core.hosts.base import Host, Shared
from rlightning_aio._core.hosts.completion_frames import completion_in
from rlightning_aio._core.hosts.descriptors import Inbox
from rlightning_aio._core.hosts.limits import limits_of
from rlightning_aio._core.hosts.messages import Attached, Built, Closed, Death, Died, Reported
from rlightning_aio._core.hosts.ray.actor import Batch, EnvActor, Reply, RowTable
from rlightning_aio._core.hosts.running.runner import placed
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.entries import op_of
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.pickling import dumped, dumped_with_code

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, EnvStarted, StartOrder
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.protocol.frames import Frame

# Untyped, because `make check` runs without Ray.
ray: Any = import_module("ray")

_OURS: Final = {
    "num_cpus": "is a field of the entry",
    "num_gpus": "is a field of the entry",
    "max_restarts": "is a field of the entry, and Ray itself restarts nothing",
    "max_task_retries": "would execute a step twice",
    "lifetime": "would let actors outlive the trainer",
    "name": "belongs to one actor, and an entry may have several",
    "get_if_exists": "would share an actor with others",
    "max_concurrency": "would execute several requests at a time",
    "concurrency_groups": "would execute several requests at a time",
    "allow_out_of_order_execution": "would execute requests in another order",
}
"""Options of an actor that users must not set, with the reasons."""

_OF_ANOTHER_PROCESS: Final[list[_Life]] = []
"""Actors that a forked process inherited. It keeps them, because Ray would report their release to
the cluster, over sockets that the parent uses.
"""


class _Connection(Shared):
    """The connection of this process to a cluster; see `base.Shared`.

    A connection that the program made itself is used and left open. Otherwise one connection serves
    all groups and ends with the last of them, as does a cluster that was started for it.
    """

    _users: ClassVar[int] = 0
    _is_ours: ClassVar[bool] = False

    def __init__(self, address: str | None) -> None:
        if not ray.is_initialized():
            ray.init(address=address)
            _Connection._is_ours = True
        _Connection._users += 1

    def release(self, seconds: float) -> None:
        del seconds
        _Connection._users -= 1
        if _Connection._is_ours and not _Connection._users:
            _Connection._is_ours = False
            ray.shutdown()


@dataclass
class _Sent:
    """A batch of requests that was sent to an actor.

    Attributes:
        entries: of the requests.
        outcome: what came back; None until then.
    """

    entries: NDArray[np.int64]
    outcome: Reply | Exception | None = None


class _Life:
    """One actor, from its start to its end.

    Attributes:
        actor: Ray's handle.
        inbox: for its replies.
        is_placed: a node has started it.
        is_built: its envs are built.
        sent: unanswered batches, in the order of execution.
        began_ns: when the first of them was sent, or became the first.
    """

    def __init__(self, actor: Any) -> None:
        self.actor = actor
        self.inbox = Inbox()
        self.is_placed = self.is_built = False
        self.sent: deque[_Sent] = deque()
        self.began_ns = 0
        # References to keep until a call returns, by the number of the call. The trainer's thread
        # must drop them: one of Ray's threads would wait for a lock that it holds.
        self._kept: dict[int, object] = {}
        self._num_calls = 0

    def call(self, method: Any, then: Callable[[_Life, Any], None], *arguments: Any) -> None:
        """Call a method of the actor; `then` gets the outcome on the thread of the trainer."""
        self._num_calls = number = self._num_calls + 1
        put = self.inbox.put

        def completed(outcome: Any) -> None:
            put(lambda: self._completed(number, then, outcome))

        self._kept[number] = None
        try:
            self._kept[number] = reference = method.remote(*arguments)
        except Exception as error:  # We are no longer connected to a cluster.
            completed(error)
        else:
            # `reference.future()` uses this, too, but would add a lock and a condition.
            reference._on_completed(completed)  # noqa: SLF001

    def _completed(self, number: int, then: Callable[[_Life, Any], None], outcome: Any) -> None:
        del self._kept[number]
        then(self, outcome)

    def end(self) -> None:
        """Kill the actor, and drop its replies."""
        self.inbox.close()
        self._kept.clear()
        if ray.is_initialized():
            with suppress(Exception):  # It has ended by itself.
                ray.kill(self.actor)


class RayHost(Host):
    """The trainer's handle on one actor; see `base.Host`, `Source` and `Killable`.

    Raises:
        ConfigError: `ray_options` can't be used.
    """

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self._config = order.config
        self._limits = limits_of(order.config)
        self._actor_class = _actor_class(order.config)
        self._start_payload = dumped_with_code(order)
        self._wiring = wiring
        self._post = wiring.completions.append
        self._pid = os.getpid()
        self._life: _Life | None = None
        self._started: list[EnvStarted] = []
        self._order: AttachOrder | None = None
        self._table: RowTable | None = None
        self._closing = False
        # Only Ray knows the progress of a transfer.
        self.traffic = 0

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        self._closing = False
        resources = self._wiring.resources
        try:
            if _Connection not in resources:
                resources[_Connection] = _Connection(self._config.ray_options.get("address"))
            actor = self._actor_class.remote(self.first_slot, list(sys.path))
        except Exception as error:
            raise ConnectionError(f"Ray made no actor: {error}") from error
        life = self._life = _Life(actor)
        self._wiring.driver.watch(self)
        life.call(actor.hello, self._on_placed)
        life.call(actor.build, self._on_built, self._start_payload, self._order is not None)

    def attach(self, order: AttachOrder) -> None:
        """Map the rows of the trainer; the actor has its own."""
        self._order = order
        # A replacement is not built yet.
        if self._life is not None and self._life.is_built:
            self._attached(order)

    def _attached(self, order: AttachOrder) -> None:
        if self._table is None:
            found = placed(self._started, order, self._wiring.arena.map)
            places = [(slab, row) for _, slab, row in found]
            self._table = RowTable(self.first_slot, places)
        self._post(Attached(self.host_id))

    def kill(self, *, dump: bool) -> None:
        """Kill the actor, which writes no stacks."""
        del dump
        if self._closing:
            self._end("did not close in time and was killed")
        elif self._life is not None and not self._life.is_placed:
            self._end(f"could not be placed: it asks for {_asked(self._config)}")
        else:
            self._end("was killed", -9)

    def destroy(self) -> None:
        """Kill the actor; `kill` always has an effect."""
        self.kill(dump=False)

    def close(self) -> None:
        self._closing = True
        if self._life is not None and self._life.is_placed:
            self._life.call(self._life.actor.close, self._on_closed)
        else:
            self.release()
            self._post(Closed(self.host_id, []))

    def release(self) -> None:
        life, self._life = self._life, None
        if life is None:
            return
        if os.getpid() != self._pid:
            _OF_ANOTHER_PROCESS.append(life)
            return
        self._wiring.driver.unwatch(self)
        life.end()

    def _end(self, cause: str, exit_code: int | None = None) -> None:
        """Release the actor, and report its death."""
        life = self._life
        if life is None:
            return
        # It was executing the first batch.
        requests: list[int] = [entry for sent in life.sent for entry in sent.entries.tolist()]
        self.release()
        if self._closing:
            text = ErrorText("WorkerDied", f"its worker {cause}", "")
            errors = [(index, text) for index in range(self.num_envs)]
            self._post(Closed(self.host_id, errors))
        else:
            death = Death(cause, exit_code, requests=tuple(requests))
            self._post(Died(self.host_id, death))

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> bytes:
        return dumped(arguments, "it")

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[bytes] | None = None) -> None:
        life = self._life
        if life is None:
            return
        assert self._table is not None
        columns = self._table.requests(entries, seeds=arguments is None)
        if not life.sent:
            life.began_ns = time.monotonic_ns()
        sent = _Sent(entries)
        life.sent.append(sent)
        then = partial(self._on_reply, sent)
        life.call(life.actor.execute, then, Batch(entries, columns, arguments))

    def current_request(self) -> tuple[int, int]:
        """Return the entry being executed and its start, as of `base.Killable`.

        Only the actor knows them. Time counts from sending, and a batch may take as long as the
        limits of all its requests together, because they are executed in turn: so whichever has
        used up the time of those before it counts as being executed.
        """
        life = self._life
        if life is None or not life.sent:
            return 0, 0
        entries: list[int] = life.sent[0].entries.tolist()
        now_ns, since_ns = time.monotonic_ns(), life.began_ns
        for entry in entries[:-1]:
            limit_ns = self._limits.get(op_of(entry), math.inf) * 1e9
            if now_ns < since_ns + limit_ns:
                return entry, since_ns
            since_ns += int(limit_ns)
        return entries[-1], since_ns

    def catch_up(self) -> bool:
        posted = len(self._wiring.completions)
        self.on_readable()
        return len(self._wiring.completions) != posted

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        assert self._life is not None
        return self._life.inbox.fileno()

    def on_readable(self) -> None:
        life = self._life
        for task in life.inbox.pop_all() if life is not None else ():
            if self._life is life:  # A task may end it.
                task()

    def on_writable(self) -> None:
        """Do nothing: Ray sends by itself."""

    def _has_returned(self, outcome: Any) -> bool:
        """Return True if a call returned a value; otherwise handle the end of the actor."""
        if isinstance(outcome, BaseException):
            # Ray names the actor first, and says in the last line why it ended.
            why = str(outcome).strip().rpartition("\n")[2]
            self._end(f"was lost: {why[:300]}")
            return False
        return True

    def _on_placed(self, life: _Life, outcome: Any) -> None:
        if self._has_returned(outcome):
            life.is_placed = True

    def _on_built(self, life: _Life, outcome: Frame | Exception) -> None:
        if not self._has_returned(outcome):
            return
        assert not isinstance(outcome, Exception)
        completion = completion_in(self.host_id, outcome)
        self._post(completion)
        if not isinstance(completion, Built):
            return
        self._started = completion.started
        life.is_built = True
        if self._order is not None:  # A replacement has its order already.
            self._attached(self._order)

    def _on_reply(self, sent: _Sent, life: _Life, outcome: Reply | Exception) -> None:
        """Apply replies in the order of execution: results need the schemas of earlier ones.

        Ray may deliver a large reply later than a small one that came after it.
        """
        sent.outcome = outcome
        while life.sent and (first := life.sent[0].outcome) is not None:
            if not self._has_returned(first):
                return
            assert isinstance(first, Reply)
            life.sent.popleft()
            life.began_ns = time.monotonic_ns()
            self._apply(first)

    def _apply(self, reply: Reply) -> None:
        """Write results into their rows, and post the completions of a batch."""
        assert self._table is not None
        self._table.put_results(reply.with_rows(), reply.columns, time.monotonic_ns())
        for frame in reply.frames:
            self._post(completion_in(self.host_id, frame))
        if len(reply.done):
            self._post(Reported(self.host_id, reply.done))

    def _on_closed(self, life: _Life, outcome: Any) -> None:
        del life
        if self._has_returned(outcome):
            self.release()
            self._post(Closed(self.host_id, outcome))


def _actor_class(config: EnvConfig) -> Any:
    """Return the class of an entry's actors, whose ``.remote(...)`` makes one.

    Raises:
        ConfigError: `ray_options` has an option that is unknown, wrong, or not allowed.
    """
    options = {name: value for name, value in config.ray_options.items() if name != "address"}
    for name in options.keys() & _OURS.keys():
        raise ConfigError(
            f"entry {config.name!r}, ray_options.{name}: leave it out; it {_OURS[name]}"
        )
    if config.env_vars:
        runtime_env = dict(options.get("runtime_env") or {})
        env_vars = {**runtime_env.get("env_vars", {}), **config.env_vars}
        options["runtime_env"] = {**runtime_env, "env_vars": env_vars}
    remote = ray.remote(max_restarts=0)(EnvActor)
    try:
        return remote.options(num_cpus=config.num_cpus, num_gpus=config.num_gpus, **options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"entry {config.name!r}, ray_options: {error}") from error


def _asked(config: EnvConfig) -> str:
    """Return what decides where an actor of an entry may live."""
    asked = {"num_cpus": config.num_cpus, "num_gpus": config.num_gpus, **config.ray_options}
    elsewhere = ("address", "runtime_env")
    return ", ".join(f"{name}={value}" for name, value in asked.items() if name not in elsewhere)
