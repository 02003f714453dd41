"""`Supervisor`: the life of a group's hosts, from their first start to their end.

It starts hosts, places their envs in slabs, and replaces dead hosts; `Shutdown` closes them. It
returns what a death means for envs and their requests (`HostLoss`), and `Intake` carries it out.
Rule: it waits only by yielding a `Wait`. Callers pass the time in, except for a death, which
may be found at any moment, and for what a host was ordered to do: the trainer may have been stopped
until then. `HangDetector` decides which workers are killed.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeAlias

from rlightning_aio._core.group.drivers.wait import Patient, Procedure, Wait, earliest
from rlightning_aio._core.group.state.conditions import DEATH
from rlightning_aio._core.group.state.host_record import HostRecord, Stage
from rlightning_aio._core.group.state.slab_layout import check_actions
from rlightning_aio._core.group.supervision.env_losses import EnvLosses
from rlightning_aio._core.group.supervision.fault_messages import (
    CrashLog,
    cause_of,
    culprit_of,
    host_loss,
    late_fault,
    start_fault,
    without_terminal,
)
from rlightning_aio._core.group.supervision.hang_detector import HangDetector
from rlightning_aio._core.group.supervision.hint import Hint
from rlightning_aio._core.group.supervision.places import Places
from rlightning_aio._core.group.supervision.renewals import Renewals
from rlightning_aio._core.group.supervision.shutdown import Shutdown
from rlightning_aio._core.group.supervision.workers import Overdue, Workers
from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.limits import restart_pause
from rlightning_aio._core.hosts.messages import (
    Attached,
    AttachOrder,
    Built,
    Closed,
    Death,
    Died,
    NotBuilt,
)
from rlightning_aio.errors import (
    ConfigError,
    GroupClosed,
    RemoteTraceback,
    RLightningError,
    StartFailed,
)
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.host_record import HostLoss
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.base import Host
    from rlightning_aio._core.hosts.messages import Taken
    from rlightning_aio.config import EnvConfig

LOOK_SECONDS: Final = 0.02
"""Interval of checks in a trainer that never has to wait."""

_log = logging.getLogger("rlightning_aio")

Lifecycle: TypeAlias = Built | NotBuilt | Attached | Closed
"""Completions that only the supervisor applies."""


class Supervisor:
    """The hosts of one group and the memory that they share with it.

    Attributes:
        hosts: in the order of their slots; records: of them.
        places: the hosts whose workers start themselves.
        detector: finds workers that hang.
        shutdown: ends the hosts; workers: describes them; hint: on settings; crash_log: of
            restarts; losses: of single envs; overdue: names envs that owe a result for long;
            renewals: replaces workers before they fail.
        metas: one for each env; empty before the start.
        any_deaths: a worker died or an env raised, and what came in its place has not completed a
            step yet; or a recycled worker closes, or the next one starts. `check` looks at the
            times of starts and ends only then.
        close_errors: env id and error of each env whose `close` raised.
        look_by: time by which a trainer that never waits must call `check`.
        due: time by which a call that waits must call it, though nothing has happened. It moves
            only once it has passed.
        patient: what a call waits for that has no other time to keep: until `due`.
        clock: monotonic seconds.
    """

    def __init__(self, tables: Tables) -> None:
        self.hosts: list[Host] = []
        self.records = tables.records
        self.any_deaths = False
        self.metas: list[EnvMeta] = []
        self.close_errors: list[tuple[str, ErrorText]] = []
        self.look_by = 0.0
        self.due = math.inf
        self.patient = Patient()
        self._tables = tables
        self._envs = tables.envs
        self._requests = tables.requests
        self._lifetime = tables.lifetime
        self.clock = tables.clock
        self.places = Places(tables)
        self.detector = HangDetector(tables)
        self.shutdown = Shutdown(tables)
        self.workers = Workers(tables)
        self.hint = Hint(tables)
        self.overdue = Overdue(tables)
        self.crash_log = CrashLog()
        self.renewals = Renewals(tables, self.replace, self._update_any_deaths)
        self.losses = EnvLosses(tables, self.crash_log, self._update_any_deaths)
        self._start_fault: Exception | None = None

    def add(self, host: Host, config: EnvConfig, peer: HostRecord | None = None) -> None:
        """Add a host before the start; its slots follow those of the previous host.

        That of a `peer` has the same slots, and is started when its worker is due.
        """
        self.hosts.append(host)
        record = HostRecord(host, config, peer=peer)
        if peer is not None:
            peer.peer, record.stage = record, Stage.CLOSED
        self.records.append(record)
        self.detector.add(record)
        if record.place is not None:
            self.places.add(record)

    # -- start --------------------------------------------------------------------

    def start(self, now: float) -> Procedure[list[EnvMeta]]:
        """Build all envs in parallel and place them."""
        if self._lifetime.closed:
            raise GroupClosed("this group is closed; build a new one")
        if self._lifetime.open:
            return self.metas
        first = [record for record in self.records if record.stage is Stage.NEW]
        if not first:
            raise RLightningError("another init() is starting this group; wait for that one")
        try:
            for record in first:
                self._launch_first(record)
            yield from self._until(Stage.BUILT)
            self._lay_out_rows()
            for record in first:
                if record.place is not None:
                    self.places.leave(record)
                    continue
                assert record.order is not None
                record.host.attach(record.order)
                record.give_time(self.clock())
            yield from self._until(Stage.UP)
            for record in first:
                if record.place is not None:  # From now on somebody may dial in, and leave.
                    record.host.attach(AttachOrder((), (), record.close_seconds))
        except BaseException:
            yield from self.shutdown.close(self.clock())
            # Its traceback refers to the group, which would then never be garbage-collected.
            self._start_fault = None
            raise
        self._lifetime.begin()
        self.overdue.begin(self.clock())
        self.plan()
        _log.info("started within %.1f s: %s", self.clock() - now, self.workers.summary())
        return self.metas

    def _launch_first(self, record: HostRecord) -> None:
        try:
            self._launch(record, Stage.BUILDING)
        except OSError as error:
            raise StartFailed(
                _refusal(record, error), env_id=self._envs.env_ids[record.slots.start]
            ) from error

    def _launch(self, record: HostRecord, stage: Stage) -> None:
        record.stage = stage
        record.late = False
        record.launches += 1
        record.host.start()
        record.give_time(self.clock())

    def _until(self, stage: Stage) -> Procedure[None]:
        until: float | None = 0.0  # Hosts in this process have posted completions already.
        while True:
            now = yield Wait(until)
            if self._lifetime.closed:
                raise GroupClosed("the group was closed while it was starting")
            self._check_start_times(now)
            if self._start_fault is not None:
                raise self._start_fault
            if all(r.stage.value >= stage.value for r in self.records):
                return
            until = earliest(*(r.start_by for r in self.records))

    def _check_start_times(self, now: float) -> None:
        for record in self.records:
            if record.start_by is None or now < record.start_by:
                continue
            if self.detector.read_news(record) or record.note_traffic():
                if not record.late:
                    record.give_time(self.clock())
            elif not record.late:
                record.late = True
                self.detector.kill(record, dump=True)
                record.start_by = self.clock() + times.DUMP  # The death brings its stacks.
            else:
                record.start_by = None  # A host that can't be killed gets no second limit.
                if not self._lifetime.open:
                    self._fail_start(late_fault(self._envs, record, Death("")))

    def _fail_start(self, fault: Exception) -> None:
        self._start_fault = self._start_fault or fault

    def _lay_out_rows(self) -> None:
        """Give each env a row in the slab of its layout."""
        started = [env for record in self.records for env in record.started]
        self.metas = [env.meta for env in started]
        if not self._tables.mixed_actions:
            check_actions(self.metas)
        for slot in range(self._envs.num_local, len(self._envs)):
            config, env_id = self._envs.configs[slot], self._envs.env_ids[slot]
            self.metas.append(
                EnvMeta(
                    env_id=env_id,
                    observation_space=None,
                    action_space=None,
                    num_envs=config.num_envs,
                    max_episode_steps=config.max_episode_steps,
                )
            )
        layout = self._tables.layout
        layout.lay_out(started, self._tables.arena)
        self._envs.note_started(started)
        for record in self.records:
            if record.place is None:
                count, seconds = len(record.started), record.close_seconds
                record.order = layout.order_for(record.slots.start, count, seconds)

    def handle(self, completion: Lifecycle) -> None:
        """Apply a completion about the life of a host; `handle_exit` applies deaths."""
        record = self.records[completion.host_id]
        if isinstance(completion, Built):
            self._on_built(record, completion.started)
        elif isinstance(completion, NotBuilt):
            self._on_not_built(record, record.slots[completion.env_index], completion.error)
        elif isinstance(completion, Attached):
            if record.rebuild_error is None:
                self._on_attached(record)
        else:
            was_built = record.stage not in (Stage.BUILDING, Stage.REBUILDING)
            # The start error of a host that was killed while it started is known already.
            owed = self._requests.owed(self._tables.slots_of(record))
            for index, error in completion.errors if was_built else ():
                if len(owed) and error.type_name == "WorkerDied":
                    late = self._envs.env_ids[owed.item(0)]
                    error = replace(error, text=f"{error.text}; {late} owed a reply")  # noqa: PLW2901
                env_id = self._envs.env_ids[record.slots[index]]
                self.close_errors.append((env_id, error))
            record.stage = Stage.CLOSED
            if self._lifetime.open:
                self.renewals.note_closed(record)

    def _on_built(self, record: HostRecord, started: list[Any]) -> None:
        if record.stage is Stage.BUILDING:
            record.started = started
            record.stage = Stage.BUILT
            record.start_by = None
        elif [env.layout.key for env in started] != [env.layout.key for env in record.started]:
            error = ErrorText("ValueError", "its spaces changed with the restart", "")
            self._on_not_built(record, record.slots.start, error)

    def _on_attached(self, record: HostRecord) -> None:
        record.stage = Stage.UP
        record.start_by = None
        record.idle = ()
        if 0 in record.deaths.values():  # It has started, and these count none.
            record.deaths = {slot: count for slot, count in record.deaths.items() if count}
            self._update_any_deaths()
        held, record.held = record.held, []
        for entries, arguments in held:
            record.host.submit(entries, arguments)
        if record.peer is not None:
            self.renewals.close_if_left(record.peer.host.host_id)

    def _on_not_built(self, record: HostRecord, slot: int, error: ErrorText) -> None:
        if self._lifetime.open:
            record.rebuild_error, record.culprit = record.rebuild_error or error, slot
            self.detector.kill(record, dump=False)
            return
        # ConfigError keeps its type, because the config is wrong for every process.
        if error.type_name == "rlightning_aio.errors.ConfigError":
            self._fail_start(ConfigError(error.text))
            return
        fault = StartFailed(
            f"{self._envs.describe(slot)} could not be built: {error.summary}"
            f"{without_terminal(error, record)}; its __cause__ is the remote traceback",
            env_id=self._envs.env_ids[slot],
        )
        fault.__cause__ = RemoteTraceback(error.traceback)
        self._fail_start(fault)

    # -- requests --------------------------------------------------------

    def packed(self, slot: int, arguments: Any, what: str) -> Any:
        """Return arguments as the host of `slot` sends them; `what` names them in an error."""
        try:
            return self._tables.record_of(slot).host.packed(arguments)
        except Exception as error:
            raise TypeError(
                f"{what} for {self._envs.describe(slot)} can't be sent to its worker: {error}; "
                "nothing was sent"
            ) from error

    def hand_over(
        self,
        slots: NDArray[np.intp],
        entries: NDArray[np.int64],
        arguments: Sequence[Any] | None = None,
    ) -> None:
        """Give issued requests to their hosts, one call per run of slots of the same host."""
        for host_id, part in self._requests.put_in_flight(slots):
            given = None if arguments is None else arguments[part]
            self.submit(host_id, entries[part], given)

    def submit(
        self, host_id: int, entries: NDArray[np.int64], arguments: Sequence[Any] | None
    ) -> None:
        """Pass requests to a host, or hold them until its replacement is up."""
        record = self.records[host_id]
        if record.is_down:
            if record.place is not None:
                self.places.hold(record, entries, arguments)
            else:
                record.held.append((entries, arguments))
                if record.stage is Stage.DOWN and record.restart_at is None:
                    self._plan_restart(record)
                    self._update_any_deaths()
                    self._restart(record, self.clock())
        else:
            record.host.submit(entries, arguments)

    # -- faults -------------------------------------------------------------------

    def next_check(self, until: float | None = None) -> float | None:
        """Return the time by which `check` must be called, or `until` if that is earlier."""
        moments = [until, self.patient.until]
        if self.detector.any_ending:
            moments += self.detector.expiries()
        if self.any_deaths:
            moments += [due for r in self.records for due in (r.start_by, r.restart_at)]
        return min((moment for moment in moments if moment is not None), default=None)

    def plan(self) -> None:
        """Set the time of the next look."""
        self.due = min(self.detector.due, self.overdue.due)
        self.patient.until = None if self.due == math.inf else self.due

    def check(self, now: float) -> None:
        """Restart hosts that are due, and find workers that hang."""
        if not self._lifetime.open:
            raise GroupClosed("the group was closed while this call was waiting")
        self.look_by = now + LOOK_SECONDS
        if self.any_deaths:
            self._check_start_times(now)
            for record in self.records:
                self._restart(record, now)
        if now >= self.detector.due or self.detector.any_ending:
            self.detector.check(now)
        if now >= self.overdue.due:
            self.overdue.look(now)
        if now >= self.due:
            self.plan()

    # -- deaths -------------------------------------------------------------------

    def handle_exit(self, exited: Died) -> HostLoss | None:
        """Decide what the end of a worker means, which `Intake` carries out.

        Returns None where it means nothing for requests: while the group starts or closes, and
        where a replacement that never came up is replaced again. That is started here, and requests
        wait for it.
        """
        record, death = self.records[exited.host_id], exited.death
        record.dying, record.abort_by = False, {}
        if not self._lifetime.open:
            record.stage = Stage.CLOSED
            self._fail_start(start_fault(self._envs, record, death))
            return None
        if death.refused:
            record.restarts -= 1  # It has not started.
        was_up = record.stage is Stage.UP
        if not was_up:
            self.renewals.give_back(record)
        owed = self._requests.owed(self._tables.slots_of(record))
        if record.place is not None:
            return self._lose_client(record, death, owed)
        loss = record.last_loss = self._judged(record, death, owed)
        record.start_by, record.stage = None, Stage.DOWN
        if not loss.replaced:  # The next request starts a worker.
            record.held = []
            self._update_any_deaths()
            return loss
        self._plan_restart(record)
        if was_up:
            return loss
        self.replace(record.host.host_id)
        return None

    def _plan_restart(self, record: HostRecord) -> None:
        record.restart_at = self.clock() + restart_pause(record.deaths.get(record.culprit, 0))

    def _lose_client(self, record: HostRecord, death: Death, owed: NDArray[np.intp]) -> HostLoss:
        """Decide what the loss of a client means: whoever takes the place next replaces it."""
        loss = self._judged(record, death, owed)
        # After too many losses in a row the error is raised, and the next request waits again.
        loss = record.last_loss = replace(loss, replaced=True, resets=loss.resets and loss.replaced)
        self.places.leave(record)
        self._update_any_deaths()
        return loss

    def take(self, taken: Taken) -> list[tuple[NDArray[np.int64], Sequence[Any] | None]]:
        """Note that a client has taken a place; return the request that was held for it."""
        record = self.records[taken.host_id]
        slot = record.slots.start
        record.restarts += record.was_shown
        record.deaths = {slot: count for slot, count in record.deaths.items() if count}
        self.places.take(record, taken)
        # The first client decides for all places of its entry.
        is_first, envs = self.metas[slot].action_space is None, self._envs
        for other in range(envs.num_local, len(envs)):
            if other == slot or (is_first and envs.configs[other] is envs.configs[slot]):
                most = envs.step_limits.item(other) or None
                update = {"env_id": envs.env_ids[other], "max_episode_steps": most}
                self.metas[other] = taken.started.meta.model_copy(update=update)
        self._update_any_deaths()
        return self.places.release(record)

    def objection(self, meta: EnvMeta) -> str | None:
        """Return the reason why the env of a client doesn't fit the group, or None."""
        return self.places.objection(meta, self.metas)

    def replace(self, host_id: int) -> int:
        """Start the replacement of a host at once, if it needn't pause: `check` starts others.

        A place stays empty, until a client takes it.

        Returns the host that has its envs now: the next worker may have been started already.
        """
        record = self.records[host_id]
        if record.peer is not None and self.renewals.inherits(record):
            return record.peer.host.host_id
        self._restart(record, self.clock())
        return host_id

    def _restart(self, record: HostRecord, now: float) -> None:
        if record.restart_at is None or record.restart_at > now:
            return
        record.restart_at = None
        record.restarts += 1
        try:
            self._launch(record, Stage.REBUILDING)
        except OSError as error:
            death = Death(f"could not be replaced: {_refusal(record, error)}", refused=True)
            self._tables.completions.append(Died(record.host.host_id, death))
            return
        assert record.order is not None
        record.host.attach(record.order)
        record.give_time(self.clock())

    def _judged(self, record: HostRecord, death: Death, owed: NDArray[np.intp]) -> HostLoss:
        """Count a death, decide if the host is replaced, log that, and return what it means."""
        requests = self._requests
        if death.with_server and not record.is_hung:
            record.culprit = record.aborted_slot  # No env of it is at fault.
        elif record.stage is Stage.UP and not record.is_hung:
            # A replacement that fails to start counts against the env that made it necessary.
            record.culprit = culprit_of(record, death.requests, requests, owed)
        # A worker killed for an abort, or a client that said goodbye, did nothing wrong.
        is_fault = record.aborted_slot is None and not death.in_order
        deaths = record.deaths.get(record.culprit, 0) + is_fault
        record.deaths[record.culprit] = deaths
        self._note_deaths(True)
        replaced, then = True, "it is replaced"
        slots: list[int] = self._tables.slots_of(record).tolist()
        if is_fault and slots:  # Else the worker before goes on.
            replaced, then = record.restart_policy.count(deaths)
        if record.place is not None:
            then = then if not replaced else "its place waits for a client"
        if is_fault and record.is_hardware:
            then += "; it moves nothing until you reset it"
        death = replace(death, cause=cause_of(record, death, requests))
        loss = host_loss(self._envs, requests, record, death, slots, owed, then, replaced=replaced)
        if not is_fault:
            _log.info("%s", loss.message)
        elif replaced:
            self.crash_log.note(record.config.name, loss.message)
        record.is_hung, record.aborted_slot, record.rebuild_error = False, None, None
        return loss

    def note_step(self, slot: int) -> None:
        """Record that an env completed a step, so it is not what its worker died of."""
        deaths = self.records[self._requests.hosts.item(slot)].deaths
        if deaths:
            deaths.pop(slot, None)
            deaths.pop(None, None)
            self._update_any_deaths()

    def _update_any_deaths(self) -> None:
        self._note_deaths(
            any(
                record.deaths
                for record in self.records
                if record.stage is not Stage.DOWN or record.restart_at is not None
            )
        )

    def _note_deaths(self, any_deaths: bool) -> None:
        self.any_deaths = any_deaths
        self._tables.conditions.note(DEATH, any_deaths)


def _refusal(record: HostRecord, why: OSError) -> str:
    refusal = f"can't start a worker for entry {record.config.name!r}: {why}"
    if isinstance(why, ConnectionError):
        return refusal
    return f"{refusal}; check its `interpreter` and this machine's process and memory limits"
