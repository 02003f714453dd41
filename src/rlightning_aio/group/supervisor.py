"""`Supervisor`: the life of a group's hosts, from their first start to their end.

It starts them, has their envs placed in slabs, notices that one is dead or hung, replaces
it, and closes them all. What a death means for requests is the core's affair, which is told
what to do about them (`GivenUp`, `Replaced`).
Rule: it waits only by yielding a `Wait`. The time is passed in, except that of a death, which may
be found at any moment.
Rule: nobody is ended by force unheard. How long an env takes is measured by its worker, whose clock
stands still while it waits for the trainer to read. A worker that does nothing is given its time
anew whenever anything goes through between the two. And a host whose time is up is asked first for
what the trainer, late itself, has not taken in yet.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import numpy as np

from rlightning_aio.errors import ConfigError, GroupClosed, RemoteTraceback, StartFailed, WorkerDied
from rlightning_aio.group.fault_messages import (
    cause_of,
    culprit_of,
    death_error,
    late_fault,
    start_fault,
)
from rlightning_aio.group.hint import hint
from rlightning_aio.group.host_record import HostRecord, Stage
from rlightning_aio.group.slab_layout import check_actions
from rlightning_aio.group.wait import Procedure, Wait, earliest
from rlightning_aio.group.workers import describe
from rlightning_aio.hosts.base import Membership
from rlightning_aio.hosts.messages import (
    Attached,
    Built,
    Closed,
    Death,
    Died,
    ErrorText,
    NotBuilt,
)
from rlightning_aio.protocol.entries import Operation, slot_of
from rlightning_aio.registry import ENVS
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.requests import Requests
    from rlightning_aio.group.resumption import Resumption
    from rlightning_aio.group.slab_layout import SlabLayout
    from rlightning_aio.hosts.arena import Arena
    from rlightning_aio.hosts.base import Host, Shared

__all__ = ["Fate", "GivenUp", "Lifecycle", "Replaced", "Supervisor"]

_CLOSE_SECONDS: Final = 1.5
"""How long envs may take to close before their worker is killed."""
_KILL_SECONDS: Final = 0.3
"""How long the news of a kill may take to come back."""
_END_SECONDS: Final = 1.5
"""How long a fork server that is let go may take to end its workers and pass on their words."""
_LOOK_SECONDS: Final = 0.02
"""How often a trainer that never has to wait looks for what has hung."""
_OBEY_SECONDS: Final = 5.0
"""How long the death of a worker that was killed may take to come; what should have killed it has
hung then, too. Nobody but a machine that is out of breath needs a tenth of that.
"""
_DUMP_SECONDS: Final = 1.0
"""How long a worker that is late may take to write its stacks and die."""

_FIRST_PAUSE_SECONDS: Final = 0.1
"""How long the second restart in a row is put off. The first is not; each further one is, for
twice as long as the one before."""
_LONGEST_PAUSE_SECONDS: Final = 5.0

_log = logging.getLogger("rlightning_aio")

Lifecycle: TypeAlias = Built | NotBuilt | Attached | Closed
"""Completions that concern nobody but the supervisor."""
Fate: TypeAlias = Literal["hung", "died", "given up", "up"]
"""What may befall a host after its first start."""
ErrorFor: TypeAlias = Callable[["NDArray[np.intp]"], WorkerDied]
"""Makes the error for some of the slots that owed a reply."""


@dataclass(frozen=True)
class GivenUp:
    """A host is gone for good: what it owed ends in errors."""

    host: Host
    owed: NDArray[np.intp]
    error_for: ErrorFor


@dataclass(frozen=True)
class Replaced:
    """A dead host is being replaced: what it owed is to be asked anew, calls end in errors.

    Nobody but the user sets hardware in motion: unless it `resets`, all that it owed ends in
    errors. What is asked of it from now on is held until the replacement is up, however many
    attempts that takes.
    """

    host: Host
    owed: NDArray[np.intp]
    error_for: ErrorFor
    cause: str
    resets: bool


class Supervisor:
    """The hosts of one group and the memory that they share with it.

    Args:
        envs: names them in messages; requests: what they owe; layout: where they write.
        resumption: where envs of a replacement are to stand.
        arena: of the group.
        tell: takes the death of a replacement that could not be started; `bury` has the rest.
        num_cores: cores that this process and its workers may use.
        clock: monotonic seconds; asked only when a host has died.

    Attributes:
        metas: one for each local env, and for each env_server; empty before the start.
        has_members: envs may come and go.
        timed: some requests have a time limit.
        recovering: some worker was replaced and has not shown yet that it works.
        close_errors: of envs' `close`, with their ids.
        resources: what hosts share, see `base.Wiring`.
        open, closed: the group can be asked; it is over.
        tell_of: called with what has befallen a host, its number, the slot of the env that hangs
            (or -1), and the cause in words.
    """

    def __init__(
        self,
        envs: EnvTable,
        requests: Requests,
        layout: SlabLayout,
        resumption: Resumption,
        arena: Arena,
        tell: Callable[[Died], object],
        *,
        mixed_actions: bool,
        num_cores: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.hosts: list[Host] = []
        self.open = False
        self.closed = False
        self.recovering = False
        self.metas: list[EnvMeta] = []
        self.close_errors: list[tuple[str, ErrorText]] = []
        self.resources: dict[object, Shared] = {}
        self.tell_of: Callable[[Fate, int, int, str], None] = _told_to_nobody
        self._envs = envs
        self._requests = requests
        self._layout = layout
        self._resumption = resumption
        self._arena = arena
        self._tell = tell
        self._clock = clock
        self._mixed_actions = mixed_actions
        self._num_cores = num_cores
        self._records: list[HostRecord] = []
        self.has_members = False
        self._env_servers: list[tuple[Host, Membership]] = []
        self._start_fault: Exception | None = None
        self._now = 0.0
        self.timed = False
        self._looked_at = 0.0
        self._any_dying = False
        self._any_given_up = False

    def add(self, host: Host, config: EnvConfig) -> None:
        """Take in a host, before the start; its slots follow those of the host before."""
        self.hosts.append(host)
        self._records.append(HostRecord(host, config))
        self.timed = self.timed or self._records[-1].timed
        if isinstance(host, Membership):
            self._env_servers.append((host, host))
            self.has_members = True

    # -- start --------------------------------------------------------------------

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """Build all envs in parallel and place them."""
        if self.closed:
            raise GroupClosed("this group is closed; build a new one")
        if self.open:
            return self.metas
        try:
            self._now = now
            for record in self._records:
                self._launch_first(record, now)
            yield from self._until(Stage.BUILT)
            self._place()
            for record in self._records:
                assert record.order is not None
                record.stage = Stage.ATTACHING
                record.start_by = self._now + record.config.start_timeout
                record.host.attach(record.order)
            yield from self._until(Stage.UP)
        except BaseException:
            yield from self.close(self._now)
            # Its traceback leads to the group, which would never be collected.
            self._start_fault = None
            raise
        self.open = True
        self.metas += [
            EnvMeta(env_id=server.server_id, observation_space=None, action_space=None)
            for _, server in self._env_servers
        ]
        return self.metas

    def _launch_first(self, record: HostRecord, now: float) -> None:
        try:
            self._launch(record, now)
        except OSError as error:
            raise StartFailed(
                _refusal(record, error), env_id=self._envs.env_ids[record.host.first_slot]
            ) from error

    def _launch(self, record: HostRecord, now: float) -> None:
        record.stage = Stage.BUILDING
        record.start_by = now + record.config.start_timeout
        record.late = False
        record.host.start()

    def _until(self, stage: Stage) -> Procedure[None]:
        # What hosts of this very process have told waits to be taken in.
        self._now = yield Wait(0.0)
        while any(r.stage.value < stage.value for r in self._records):
            if self._start_fault is not None:
                raise self._start_fault
            self._now = yield Wait(earliest(*(r.start_by for r in self._records)))
            if self.closed:
                raise GroupClosed("the group was closed while it was starting")
            self._check_start_times()
        if self._start_fault is not None:
            raise self._start_fault

    def _check_start_times(self) -> None:
        for record in self._records:
            if record.start_by is None or self._now < record.start_by or _has_news(record):
                continue
            # Its stacks come with its death. A host that can't be killed has no other chance.
            record.start_by = None if record.late else self._now + _DUMP_SECONDS
            if not record.late:
                record.late = True
                self._kill(record, dump=True)
            elif not self.open:
                self._fail_start(late_fault(self._envs, record, Death("")))

    def _fail_start(self, fault: Exception) -> None:
        self._start_fault = self._start_fault or fault

    def _place(self) -> None:
        """Give each env a row in the slab of its layout."""
        started = [env for record in self._records for env in record.started]
        self.metas = [env.meta for env in started]
        if not self._mixed_actions:
            check_actions(self.metas)
        self._layout.place(started, self._arena)
        self._envs.note_started(started)
        for record in self._records:
            count = len(record.started)
            record.order = self._layout.order_for(record.host.first_slot, count)

    def handle(self, told: Lifecycle) -> None:
        """Take in what a host tells of its life; a death is told to `bury`."""
        record = self._records[told.host_id]
        if isinstance(told, Built):
            self._on_built(record, told.started)
        elif isinstance(told, NotBuilt):
            self._on_not_built(record, record.host.first_slot + told.env_index, told.error)
        elif isinstance(told, Attached):
            if record.rebuild_error is None:
                self._on_attached(record)
        else:
            was_built = record.stage is not Stage.BUILDING
            record.stage = Stage.CLOSED
            # One that is killed while it starts has been told of already.
            for index, error in told.errors if was_built else ():
                env_id = self._envs.env_ids[record.host.first_slot + index]
                self.close_errors.append((env_id, error))

    def _on_built(self, record: HostRecord, started: list[Any]) -> None:
        if record.order is None:
            record.started = started
            record.stage = Stage.BUILT
            record.start_by = None
        elif [env.layout.key for env in started] != [env.layout.key for env in record.started]:
            error = ErrorText("ValueError", "its spaces changed with the restart", "")
            self._on_not_built(record, record.host.first_slot, error)

    def _on_attached(self, record: HostRecord) -> None:
        record.stage = Stage.UP
        record.start_by = None
        # Until now it had nothing to do.
        record.idle = ()
        if self.open:
            self.tell_of("up", record.host.host_id, -1, "")
        held, record.held = record.held, None
        for entries, arguments in held or ():
            record.host.submit(entries, arguments)

    def _on_not_built(self, record: HostRecord, slot: int, error: ErrorText) -> None:
        if self.open:
            record.rebuild_error, record.culprit = record.rebuild_error or error, slot
            self._kill(record, dump=False)
            return
        # ConfigError keeps its type: what is wrong with the config is wrong everywhere.
        if error.type_name == "rlightning_aio.errors.ConfigError":
            self._fail_start(ConfigError(error.text))
            return
        fault = StartFailed(
            f"{self._envs.describe(slot)} could not be built: {error.summary}; the "
            f"remote traceback is above",
            env_id=self._envs.env_ids[slot],
        )
        fault.__cause__ = RemoteTraceback(error.traceback)
        self._fail_start(fault)

    # -- what can be asked --------------------------------------------------------

    def check_open(self) -> None:
        """Raises `GroupClosed` before `init` and after `close`."""
        if not self.open:
            raise GroupClosed(
                "this group is closed; build a new one"
                if self.closed
                else "this group has not been initialised; call init() first, or use it in a "
                "with block"
            )

    def check_usable(self, slots: NDArray[np.intp]) -> None:
        """Raises what befell the host of a slot, if it was given up."""
        if not self._any_given_up:
            return
        for record in self._records:
            failure = record.failure
            if failure is not None and np.isin(slots, record.slots).any():
                raise failure()

    def submit(
        self, host_id: int, entries: NDArray[np.int64], arguments: Sequence[Any] | None
    ) -> None:
        """Give requests to a host; a replacement that is not up yet gets them when it is."""
        held = self._records[host_id].held
        if held is None:
            self.hosts[host_id].submit(entries, arguments)
        else:
            held.append((entries, arguments))

    def env_server(self, server_id: str) -> tuple[Host, Membership] | None:
        """The env_server of that id, if there is one."""
        return next((pair for pair in self._env_servers if pair[1].server_id == server_id), None)

    def member_slots(self) -> list[int]:
        """Slots of the clients that are here, by env_server and name."""
        return [
            host.first_slot + index
            for host, server in self._env_servers
            for index in server.member_indices()
        ]

    def rank_members(self) -> None:
        """Count the clients' seeds after the local envs', in an order that no race decides."""
        offset = self._envs.num_seeds
        for host, server in self._env_servers:
            for index in server.member_indices():
                self._envs.seed_offset[host.first_slot + index] = offset
                offset += server.num_sub_envs(index)

    def missing(self, waited: float) -> float | None:
        """How long a reset may wait in all for clients; None if there are enough.

        Raises:
            TimeoutError: it has waited for longer than an env_server's ``connect_timeout``.
        """
        return earliest(*(server.missing(waited) for _, server in self._env_servers))

    def objection(self, meta: EnvMeta) -> str | None:
        """Why a client's env may not join: all actions must have one shape here."""
        known = [m for m in self.metas if m.action_space is not None]
        known += [m for _, server in self._env_servers for m in server.members().values()]
        try:
            if not self._mixed_actions:
                check_actions([*known[:1], meta])
        except ConfigError as error:
            return str(error)
        return None

    def describe(self, now_ns: int) -> list[dict[str, Any]]:
        """See `EnvGroup.get_workers`."""
        return [describe(record, self._envs, self._requests, now_ns) for record in self._records]

    def give_hint(self, latency_us: Mapping[str, Mapping[str, Any]]) -> None:
        """Log, at INFO, what the measured times say of the group's settings."""
        workers = Counter(
            record.config.name
            for record in self._records
            if record.killable is not None and record.is_local
        )
        configs = [record.config for record in self._records]
        text = hint(configs, workers, self._num_cores, latency_us)
        if text is not None:
            _log.info("%s; `rlightning-aio tune` measures what is best", text)

    # -- faults -------------------------------------------------------------------

    def next_check(self) -> float | None:
        """When `check` must be called at the latest."""
        times: list[float | None] = []
        if self.recovering:
            times += [due for r in self._records for due in (r.start_by, r.restart_at)]
        if self.timed:
            times += [self._expiry(r) for r in self._records if r.timed and self._in_flight(r)]
        if self._any_dying:
            times += [r.die_by or self._now for r in self._records if r.dying]
        times += [server.deadline() for _, server in self._env_servers]
        return earliest(*times)

    def _in_flight(self, record: HostRecord) -> int:
        return self._requests.in_flight[record.host.host_id]

    def _expiry(self, record: HostRecord) -> float | None:
        """When what a worker executes now will have taken too long."""
        if record.stage is not Stage.UP or record.hung_slot is not None:
            return None
        assert record.killable is not None
        entry, since_ns = record.killable.executing()
        limits = (record.config.step_timeout, record.config.reset_timeout)
        shortest = min(limit for limit in limits if limit is not None)
        if not (entry and since_ns):
            # A stopped process does nothing at all, for all that it was asked to.
            idle = record.idle == self._progress(record)
            return (record.idle_since if idle else self._now) + shortest
        op = self._requests.op(slot_of(entry))
        limit = {Operation.STEP: limits[0], Operation.RESET: limits[1]}.get(Operation(op or 3))
        # What has no limit is looked at again: what comes after it may have one.
        return self._now + shortest if limit is None else since_ns / 1e9 + limit

    def _progress(self, record: HostRecord) -> tuple[int, ...]:
        """Changes with every request, with every reply, and with every part of one."""
        assert record.killable is not None
        slots = slice(record.slots.start, record.slots.stop)
        entries = int(self._requests.entry[slots].sum())
        return self._in_flight(record), entries, record.killable.traffic

    def check(self, now: float) -> None:
        """Find what has hung, in steps and in restarts."""
        self._now = now
        if not self.open:
            raise GroupClosed("the group was closed while this call was waiting")
        self._looked_at = now
        if self.recovering:
            self._check_start_times()
            for record in self._records:
                if record.restart_at is not None and record.restart_at <= now:
                    self._restart(record, now)
        for _, server in self._env_servers:
            due = server.deadline()
            if due is not None and due <= now:
                server.tick(now)
        if self.timed:
            for record in self._records:
                if record.timed and self._in_flight(record):
                    self._check_hung(record)
        self._check_dying()

    def is_overdue(self, now: float) -> bool:
        """Whether nobody has looked after hosts for a while, having had no need to wait."""
        return now >= self._looked_at + _LOOK_SECONDS

    def _check_hung(self, record: HostRecord) -> None:
        assert record.killable is not None
        entry, since_ns = record.killable.executing()
        if not (entry and since_ns):
            progress = self._progress(record)
            if progress != record.idle:
                record.idle, record.idle_since = progress, self._now
                return
        expiry = self._expiry(record)
        if expiry is None or self._now < expiry or _has_news(record):
            return
        record.hung_slot = self._hung_slot(record, entry)
        self.tell_of("hung", record.host.host_id, record.hung_slot, "")
        self._kill(record, dump=True)

    def _kill(self, record: HostRecord, *, dump: bool) -> None:
        record.kill(dump=dump)
        if record.killable is not None:
            record.dying = self._any_dying = True

    def _check_dying(self) -> None:
        """End, with what they stand on, those that a kill has not ended."""
        if not self._any_dying:
            return
        for record in self._records:
            if not record.dying:
                continue
            if record.die_by is None:
                # Counted from here: the time may have been an old one when it was killed.
                record.die_by = self._now + _OBEY_SECONDS
            elif self._now >= record.die_by and not _has_news(record):
                assert record.killable is not None
                record.die_by = None
                record.killable.destroy()
        self._any_dying = any(record.dying for record in self._records)

    def _hung_slot(self, record: HostRecord, entry: int) -> int:
        """The env that hangs; the first that owes a reply, where nothing is executed any more."""
        owed = self._requests.owed(np.array(record.slots, np.intp))
        slot = slot_of(entry)
        return slot if slot in owed else int(owed[0])

    def bury(self, told: Died) -> GivenUp | Replaced | None:
        """Decide what becomes of a host whose worker is gone.

        Returns what follows for its requests; None while the group starts or closes, and after
        a replacement that never came up: what is asked of the host waits for the next one.
        """
        record, death = self._records[told.host_id], told.death
        record.dying, record.die_by = False, None
        if (record.stage.value < Stage.UP.value and record.order is None) or not self.open:
            record.stage = Stage.CLOSED
            self._fail_start(start_fault(self._envs, record, death))
            return None
        owed = self._requests.owed(np.array(record.slots, np.intp))
        self._resumption.settle(record.slots)
        was_up = record.stage is Stage.UP
        error_for, cause, is_last = self._judge(record, death, owed)
        self.tell_of("given up" if is_last else "died", told.host_id, -1, cause)
        if is_last:
            self._requests.lose_host(told.host_id)
            self._give_up(record, partial(error_for, owed))
            return GivenUp(record.host, owed, error_for)
        _log.warning("%s", str(error_for(owed)))
        self._put_off_restart(record)
        if not was_up:
            return None
        self._requests.lose_host(told.host_id)
        resets = not ENVS.is_hardware(record.config.backend)
        return Replaced(record.host, owed, error_for, cause, resets)

    def _put_off_restart(self, record: HostRecord) -> None:
        """Start a replacement: the first of a row at once, others after a while."""
        now = self._clock()
        record.stage = Stage.DOWN
        record.start_by = None
        record.restart_at = now + _pause(record.deaths[record.culprit])
        if record.held is None:
            record.held = []
        if record.restart_at <= now:
            self._restart(record, now)

    def _restart(self, record: HostRecord, now: float) -> None:
        record.restart_at = None
        record.restarts += 1
        try:
            self._launch(record, now)
        except OSError as error:
            cause = f"could not be replaced: {_refusal(record, error)}"
            self._tell(Died(record.host.host_id, Death(cause)))
            return
        assert record.order is not None
        standings = self._resumption.standings(record.slots)
        record.host.attach(replace(record.order, standings=standings))

    def _judge(
        self, record: HostRecord, death: Death, owed: NDArray[np.intp]
    ) -> tuple[ErrorFor, str, bool]:
        """The error that tells of a death, its cause, and whether it was one too many."""
        requests, config = self._requests, record.config
        if record.stage is Stage.UP:
            # A replacement that fails to come up falls to the env that made it necessary.
            record.culprit = culprit_of(record, death, requests, owed)
        deaths = record.deaths[record.culprit] = record.deaths.get(record.culprit, 0) + 1
        self.recovering = True
        cause = cause_of(record, death, requests)
        is_last = config.on_worker_death == "raise" or deaths > config.max_restarts
        if config.on_worker_death == "raise":
            outcome = "on_worker_death is 'raise', so it is not replaced"
        elif is_last:
            outcome = f"it is not replaced after {deaths - 1} restarts in a row (max_restarts)"
        else:
            pause = _pause(deaths)
            outcome = f"restart {deaths} of {config.max_restarts} in a row"
            outcome += f", in {pause:g} s" if pause else ""
            if ENVS.is_hardware(config.backend):
                outcome += "; it moves nothing until you reset it"
        told = replace(death, cause=cause)
        error_for = death_error(self._envs, record, told, requests, outcome)
        record.hung_slot = record.rebuild_error = None
        return error_for, cause, is_last

    def _give_up(self, record: HostRecord, failure: Callable[[], WorkerDied]) -> None:
        record.stage = Stage.FAILED
        record.start_by = record.held = None
        record.failure = failure
        self._any_given_up = True

    def note_step(self, slot: int) -> None:
        """An env has completed a step: it was not what its worker died of."""
        for record in self._records:
            if slot in record.slots:
                record.deaths.pop(slot, None)
                record.deaths.pop(None, None)

    def note_recovery(self, *, any_telling: bool) -> None:
        """Find out whether any worker has still to show that it works.

        Args:
            any_telling: a reply is still to come that tells of a replacement.
        """
        self.recovering = any_telling or any(
            record.deaths for record in self._records if record.stage is not Stage.FAILED
        )

    # -- close --------------------------------------------------------------------

    def close(self, now: float) -> Procedure[None]:
        """Close all envs; kill the workers that don't make it in time. Idempotent."""
        if self.closed:
            return
        self.closed = True
        self.open = False
        alive = [r for r in self._records if r.stage not in (Stage.NEW, Stage.CLOSED)]
        for record in alive:
            record.held = record.restart_at = None
            if record.stage in (Stage.FAILED, Stage.DOWN):
                record.stage = Stage.CLOSED
            else:
                record.host.close()
        try:
            yield from self._until_closed(alive, now + _CLOSE_SECONDS)
        finally:
            stuck = any(r.stage not in (Stage.NEW, Stage.CLOSED) for r in self._records)
            self._let_go(_KILL_SECONDS if stuck else _END_SECONDS)

    def _until_closed(self, records: Sequence[HostRecord], by: float) -> Procedure[None]:
        killed = False
        now = yield Wait(0.0)
        while any(r.stage is not Stage.CLOSED for r in records):
            if now >= by:
                if killed:
                    return  # A worker that does not even die is left to its fork server's end.
                killed, by = True, now + _KILL_SECONDS
                for record in records:
                    if record.stage is not Stage.CLOSED:
                        record.kill(dump=False)
            now = yield Wait(by)

    def _let_go(self, seconds: float) -> None:
        for record in self._records:
            record.host.release()
        for shared in self.resources.values():
            shared.release(seconds)
        self._layout.release()
        self._arena.close()

    def disown(self) -> None:
        """Leave everything to the process that has forked this one; nobody hears of it there."""
        self.closed = True
        self.open = False
        for record in self._records:
            if record.killable is not None:
                record.host.release()
        for shared in self.resources.values():
            shared.disown()

    def abandon(self) -> None:
        """Let go of everything at once: the group was dropped without being closed."""
        if self.closed:
            return
        self.closed = True
        self.open = False
        started = any(r.stage is not Stage.NEW for r in self._records)
        self._let_go(_END_SECONDS)
        if started:
            # The collector calls this: no caller's line would say anything.
            warnings.warn(
                "an EnvGroup was not closed; its envs were killed", ResourceWarning, stacklevel=1
            )


def _has_news(record: HostRecord) -> bool:
    """Whether a host has told what only waited to be taken in; what it means is judged later."""
    return record.killable is not None and record.killable.catch_up()


def _told_to_nobody(what: Fate, host_id: int, slot: int, cause: str) -> None: ...


def _pause(deaths: int) -> float:
    """Seconds before the restart that follows so many deaths in a row."""
    doublings = min(deaths - 2, 10)
    return min(_FIRST_PAUSE_SECONDS * 2.0**doublings, _LONGEST_PAUSE_SECONDS) if deaths > 1 else 0.0


def _refusal(record: HostRecord, error: OSError) -> str:
    return (
        f"can't start a worker for entry {record.config.name!r}: {error}; check its `interpreter` "
        "and this machine's process and memory limits"
    )
