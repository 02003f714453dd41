"""`Fleet`: the hosts of a group, from their first start to their last breath.

Rule: it starts workers, seats their envs in slabs, notices that one is dead or hung,
replaces it and closes them all; what a reply means to a caller is the core's affair.
Invariant: a request that a dead worker owed is answered exactly once, by a marked
result of its replacement or by one error.
"""

from __future__ import annotations

import logging
import pickle
import warnings
from collections import Counter
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.errors import (
    ConfigError,
    GroupClosed,
    RemoteTraceback,
    StartFailed,
)
from rlightning_aio.group.hint import hint
from rlightning_aio.group.lookout import Lookout
from rlightning_aio.group.member import NOBODY, Member, Stage
from rlightning_aio.group.obituary import (
    cause_of,
    culprit_of,
    death_error,
    late_fault,
    start_fault,
)
from rlightning_aio.group.seating import check_actions, order_for, seat
from rlightning_aio.group.slots import BUSY, IDLE, READY
from rlightning_aio.group.wait import Operation, Wait, earliest
from rlightning_aio.hosts.base import Death, Host
from rlightning_aio.hosts.process import END_SECONDS
from rlightning_aio.hosts.runner import NO_ACTION
from rlightning_aio.hosts.server import ServerHost
from rlightning_aio.hosts.worker import ErrorText, Started
from rlightning_aio.protocol.info import NO_INFO, PICKLED
from rlightning_aio.protocol.rings import RESET, STEP, slot_of
from rlightning_aio.protocol.slab import NO_SEED
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.group.ledger import Ledger
    from rlightning_aio.group.slots import Slots
    from rlightning_aio.hosts.arena import Arena
    from rlightning_aio.hosts.base import Watcher
    from rlightning_aio.hosts.process import ForkServer
    from rlightning_aio.protocol.slab import Slab

__all__ = ["Fleet"]

_CLOSE_SECONDS = 1.5
"""How long envs may take to close before their worker is killed."""
_KILL_SECONDS = 0.3
"""How long the news of a kill may take to come back."""
_LOOK_SECONDS = 0.02
"""How often a trainer that never has to wait looks for what has hung."""
_DUMP_SECONDS = 1.0
"""How long a worker that is late may take to write its stacks and die."""

_log = logging.getLogger("rlightning_aio")


class Fleet:
    """The hosts of one group and the memory that they share with it.

    Attributes:
        watcher: the driver; lookout: how results are come by.
        lost: slots whose env was replaced while nothing was asked of it; the next step
            has to tell.
        restarting: slots whose next reply comes from a replacement, with the cause.
        recovering: some worker was replaced and has not shown yet that it works, or has
            still to tell of it.
    """

    def __init__(
        self, slots: Slots, arena: Arena, watcher: Watcher, *, mixed_actions: bool
    ) -> None:
        self.slots = slots
        self.watcher = watcher
        self.hosts: list[Host] = []
        self.slabs: list[Slab] = []
        self.open = False
        self.closed = False
        self.elastic = False
        self.lost: dict[int, Death] = {}
        self.restarting: dict[int, Death] = {}
        self.recovering = False
        self.metas: list[EnvMeta] = []
        self.close_errors: list[tuple[str, ErrorText]] = []
        self.servers: list[ForkServer] = []
        self.lookout = Lookout(self.hosts)
        self._arena = arena
        self._mixed_actions = mixed_actions
        self._members: list[Member] = []
        self._elastic: list[ServerHost] = []
        self._start_fault: Exception | None = None
        self._now = 0.0
        self._timed = False
        self._looked_at = 0.0
        self._unavailable = False

    def deliver_to(self, ledger: Ledger) -> None:
        """Have hosts tell `ledger` of replies."""
        self._ledger = ledger
        self.on_reports = ledger.on_reports
        self.on_rest = ledger.on_rest
        self.on_value = ledger.on_value
        self.on_error = ledger.on_error
        self.on_schema = ledger.on_schema
        self.on_client = ledger.on_client
        self.on_withdrawn = ledger.on_withdrawn
        self.on_fault = ledger.on_fault

    def add(self, host: Host, config: EnvConfig) -> None:
        """Take in a host, before `init`; its slots follow those of the host before."""
        self.hosts.append(host)
        if host.inline:
            self.lookout.add_inline(host)
        if isinstance(host, ServerHost):
            self._elastic.append(host)
            self.elastic = True
        self._members.append(Member(host, config))
        self._timed = self._timed or self._members[-1].timed

    # -- start --------------------------------------------------------------------

    def start(self, now: float) -> Operation[list[EnvMeta]]:
        """Build all envs in parallel and seat them."""
        if self.closed:
            raise GroupClosed("this group is closed; build a new one")
        if self.open:
            return self.metas
        try:
            self._now = now
            for member in self._members:
                self._launch(member, now)
            yield from self._until(Stage.BUILT)
            self._seat()
            for member in self._members:
                assert member.order is not None
                member.stage = Stage.ATTACHING
                member.start_by = self._now + member.config.start_timeout
                member.host.attach(member.order)
            yield from self._until(Stage.UP)
        except BaseException:
            yield from self.close(self._now)
            # Its traceback leads to the group, which would never be collected.
            self._start_fault = None
            raise
        self.open = True
        self.metas += [
            EnvMeta(env_id=host.remote.server_id, observation_space=None, action_space=None)
            for host in self._elastic
        ]
        return self.metas

    def _launch(self, member: Member, now: float) -> None:
        member.stage = Stage.BUILDING
        member.start_by = now + member.config.start_timeout
        member.late = False
        try:
            member.host.start()
        except OSError as error:
            raise StartFailed(
                f"can't start a worker for entry {member.config.name!r}: {error}; check its "
                "`interpreter` and this machine's process and memory limits",
                env_id=self._first_id(member),
            ) from error

    def _until(self, stage: Stage) -> Operation[None]:
        while any(m.stage.value < stage.value for m in self._members):
            if self._start_fault is not None:
                raise self._start_fault
            self._now = yield Wait(earliest(*(m.start_by for m in self._members)))
            if self.closed:
                raise GroupClosed("the group was closed while it was starting")
            self._check_start_times()
        if self._start_fault is not None:
            raise self._start_fault

    def _check_start_times(self) -> None:
        for member in self._members:
            if member.start_by is None or self._now < member.start_by:
                continue
            # Its stacks come with its death. A host that can't be killed has no other chance.
            member.start_by = None if member.late else self._now + _DUMP_SECONDS
            if not member.late:
                member.late = True
                member.host.kill(dump=True)
            elif not self.open:
                self._start_fault = self._start_fault or late_fault(self.slots, member, Death(""))

    def _first_id(self, member: Member) -> str:
        return self.slots.env_ids[member.host.first_slot]

    def on_started(self, host: Host, started: list[Started]) -> None:
        """See `base.Inbox.on_started`."""
        member = self._members[host.host_id]
        if member.order is None:
            member.started = started
            member.stage = Stage.BUILT
            member.start_by = None
        elif [s.layout.key for s in started] != [s.layout.key for s in member.started]:
            self.on_start_error(
                host, 0, ErrorText("ValueError", "its spaces changed with the restart", "")
            )

    def on_start_error(self, host: Host, row: int, error: ErrorText) -> None:
        """See `base.Inbox.on_start_error`."""
        member = self._members[host.host_id]
        slot = host.first_slot + row
        if self.open:
            member.rebuild_error, member.culprit = member.rebuild_error or error, slot
            host.kill(dump=False)
            return
        # ConfigError keeps its type: what is wrong with the config is wrong everywhere.
        fault: Exception
        if error.type_name == "rlightning_aio.errors.ConfigError":
            fault = ConfigError(error.text)
        else:
            fault = StartFailed(
                f"{self.slots.describe(slot)} could not be built: {error.type_name}: "
                f"{error.text}; the remote traceback is above",
                env_id=self.slots.env_ids[slot],
            )
            fault.__cause__ = RemoteTraceback(error.traceback)
        self._start_fault = self._start_fault or fault

    def on_attached(self, host: Host) -> None:
        """See `base.Inbox.on_attached`."""
        member = self._members[host.host_id]
        member.stage = Stage.UP
        member.start_by = None

    def _seat(self) -> None:
        """Give each env a row in the slab of its layout."""
        started = [s for m in self._members for s in m.started]
        self.metas = [env.meta for env in started]
        if not self._mixed_actions:
            check_actions(self.metas)
        self.slabs, places = seat(started, self.slots, self._arena)
        self.slots.note_envs()
        self.slots.note_rows()
        for member in self._members:
            member.order = order_for(member.host, self.slots, places)

    # -- requests -----------------------------------------------------------------

    def host_of(self, slot: int) -> Host:
        """Where the env of `slot` lives."""
        return self.hosts[int(self.slots.host[slot])]

    def check_usable(self, slots: NDArray[np.intp]) -> None:
        """Raises what befell the worker of a slot, if it was given up."""
        if self._unavailable:
            host_ids: list[int] = np.unique(self.slots.host[slots]).tolist()
            for host_id in host_ids:
                failure = self._members[host_id].failure
                if failure is not None:
                    raise failure()

    def check_local(self, slots: NDArray[np.intp], what: str) -> None:
        """Raises NotImplementedError if any of `slots` belongs to a client."""
        if self.elastic and (remote := slots[slots >= len(self.slots.all)]).size:
            raise NotImplementedError(
                f"can't {what} {self.slots.describe(int(remote[0]))}: remote envs answer when they "
                "can; use step_async and collect_async"
            )

    def check_step(self, slot: int, action: Any) -> None:
        """Raises `BadAction` if a client can't take `action`, which is not in its row."""
        if slot >= len(self.slots.all) and action is not NO_ACTION:
            host = self.host_of(slot)
            assert isinstance(host, ServerHost)
            host.check_step(slot - host.first_slot, action)

    def on_slab(self, host: Host, slab: Slab) -> None:
        """See `base.Inbox.on_slab`."""
        rows = slice(host.first_slot, host.first_slot + slab.rows)
        self.slots.slab[rows] = len(self.slabs)
        self.slots.row[rows] = np.arange(slab.rows)
        self.slots.note_rows()
        self.slabs.append(slab)

    def objection(self, meta: EnvMeta) -> str | None:
        """Why a client's env may not join: all actions must have one shape here."""
        known = [m for m in self.metas if m.action_space is not None]
        known += [m for host in self._elastic for m in host.remote.clients.values()]
        try:
            if not self._mixed_actions:
                check_actions([*known[:1], meta])
        except ConfigError as error:
            return str(error)
        return None

    def is_idle(self, host: Host, row: int) -> bool:
        """See `base.Inbox.is_idle`."""
        return self.slots.state[host.first_slot + row] == IDLE

    def listener(self, server_id: str) -> ServerHost | None:
        """The env_server of that id, if there is one."""
        return next((h for h in self._elastic if h.remote.server_id == server_id), None)

    def clients(self) -> list[int]:
        """Slots of the clients that are here, by server and name."""
        return [host.first_slot + row for host in self._elastic for row in host.clients()]

    def rank_clients(self) -> None:
        """Count the clients' seeds after the local envs', in an order that no race decides."""
        offset = self.slots.num_seeds
        for host in self._elastic:
            for row in host.clients():
                self.slots.seed_offset[host.first_slot + row] = offset
                offset += host.num_envs(row)

    def lacking(self, waited: float) -> float | None:
        """How long a reset may go on waiting for clients; None if there are enough.

        Raises:
            TimeoutError: it has waited for longer than a server's ``connect_timeout``.
        """
        lacking = [host for host in self._elastic if host.missing]
        for host in lacking:
            settings = host.remote.settings
            if waited >= settings.connect_timeout:
                raise TimeoutError(
                    f"{len(host.remote.clients)} of {settings.min_clients} clients have joined "
                    f"{host.remote.server_id!r} at {host.remote.address} within "
                    f"{settings.connect_timeout} s; start more, or lower min_clients"
                )
        return min((host.remote.settings.connect_timeout for host in lacking), default=None)

    def write_seeds(self, slots: NDArray[np.intp], seeds: NDArray[np.int64]) -> None:
        """Put the seeds of resets into the rows; `NO_SEED` for none."""
        if len(self.slabs) == 1:
            self.slabs[0].seed[self.slots.row[slots]] = seeds + 1
            return
        for k, slot in enumerate(slots.tolist()):
            self.slabs[self.slots.slab[slot]].seed[self.slots.row[slot]] = seeds[k] + 1

    def claim_lost(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` were replaced without anybody being told; the next reply tells."""
        claimed = np.zeros(len(slots), np.bool_)
        for k, slot in enumerate(slots.tolist()):
            death = self.lost.pop(slot, None)
            if death is not None:
                self.restarting[slot] = death
                # Its neighbours may have shown long ago that the replacement works.
                self.recovering = True
                claimed[k] = True
        return claimed

    def forget_lost(self, slots: NDArray[np.intp]) -> None:
        """The envs are about to be reset: there is nothing to tell."""
        if self.lost:
            for slot in slots.tolist():
                self.lost.pop(slot, None)

    def give_hint(self, latency_us: Mapping[str, Mapping[str, Any]]) -> None:
        """Log, at INFO, what the measured times say of the group's settings."""
        workers = Counter(
            member.config.name
            for member in self._members
            if not (member.host.inline or member.host.elastic)
        )
        configs = [member.config for member in self._members]
        text = hint(configs, workers, self.lookout.num_cores, latency_us)
        if text is not None:
            _log.info("%s; `rlightning-aio tune` measures what is best", text)

    # -- faults -------------------------------------------------------------------

    def next_check(self) -> float | None:
        """When `check` must be called at the latest."""
        times: list[float | None] = [m.start_by for m in self._members] if self.recovering else []
        if self._timed:
            times += [self._expiry(m) for m in self._members if m.timed and m.host.in_flight]
        times += [host.deadline() for host in self._elastic]
        return earliest(*times)

    def _expiry(self, member: Member) -> float | None:
        """When what a worker executes now will have taken too long."""
        if member.stage is not Stage.UP or member.hung_slot is not None:
            return None
        entry, since_ns = member.host.executing()
        limits = (member.config.step_timeout, member.config.reset_timeout)
        shortest = min(limit for limit in limits if limit is not None)
        if not entry:
            # A stopped process does nothing at all, for all that it was asked to.
            idle = member.idle == self._progress(member)
            return (member.idle_since if idle else self._now) + shortest
        op = self.slots.op(slot_of(entry))
        limit = limits[0] if op == STEP else limits[1] if op == RESET else None
        # What has no limit is looked at again: what comes after it may have one.
        return self._now + shortest if limit is None else since_ns / 1e9 + limit

    def _progress(self, member: Member) -> tuple[int, ...]:
        """Changes with every request and with every reply."""
        first = member.host.first_slot
        entries = self.slots.entry[first : first + member.host.rows]
        return (member.host.in_flight, int(entries.sum()))

    def check(self, now: float) -> None:
        """Find what has hung, in steps and in restarts."""
        self._now = now
        if not self.open:
            raise GroupClosed("the group was closed while this call was waiting")
        self._looked_at = now
        if self.recovering:
            self._check_start_times()
        for host in self._elastic:
            due = host.deadline()
            if due is not None and due <= now:
                host.tick(now)
        if not self._timed:
            return
        for member in self._members:
            if member.timed and member.host.in_flight:
                self._check_hung(member)

    def overdue(self, now: float) -> bool:
        """Whether nobody has looked after workers for a while, having had no need to wait."""
        return now >= self._looked_at + _LOOK_SECONDS

    def look(self, now: float) -> None:
        """Call `check`, but not too often."""
        if self.overdue(now):
            self.check(now)

    def _check_hung(self, member: Member) -> None:
        entry, _ = member.host.executing()
        progress = self._progress(member)
        if not entry and progress != member.idle:
            member.idle, member.idle_since = progress, self._now
            return
        expiry = self._expiry(member)
        if expiry is None or self._now < expiry:
            return
        if not entry:
            # Its replies may lie here unread: it is idle by right.
            member.host.on_readable()
            if self._progress(member) != progress or member.host.executing()[0]:
                return
        member.hung_slot = slot_of(entry) if entry else self._first_busy(member)
        member.host.kill(dump=True)

    def _first_busy(self, member: Member) -> int:
        first, last = member.host.first_slot, member.host.first_slot + member.host.rows
        busy = self.slots.state[first:last] == BUSY
        return first + int(busy.argmax())

    def on_death(self, host: Host, death: Death) -> None:
        """See `base.Inbox.on_death`."""
        member = self._members[host.host_id]
        if (member.stage.value < Stage.UP.value and member.order is None) or not self.open:
            member.stage = Stage.CLOSED
            fault = start_fault(self.slots, member, death)
            self._start_fault = self._start_fault or fault
            return
        self._ledger.absorb()
        slots = np.arange(host.first_slot, host.first_slot + host.rows)
        states = self.slots.state[slots]
        owed = slots[states == BUSY]
        self._ledger.detach_infos(slots[states == READY])
        if member.stage is Stage.UP:
            # A replacement that fails to come up falls to the env that made it necessary.
            member.culprit = culprit_of(self.slots, member, death, owed)
        deaths = member.deaths[member.culprit] = member.deaths.get(member.culprit, 0) + 1
        self.recovering = True
        cause = cause_of(self.slots, member, death)
        raises = member.config.on_worker_death == "raise"
        if raises:
            outcome = "on_worker_death is 'raise', so it is not replaced"
        elif deaths > member.config.max_restarts:
            outcome = f"it is not replaced after {deaths - 1} restarts in a row (max_restarts)"
        else:
            outcome = f"restart {deaths} of {member.config.max_restarts} in a row"
        error_for = death_error(self.slots, member, replace(death, cause=cause), outcome)
        member.hung_slot = member.rebuild_error = None
        if raises or deaths > member.config.max_restarts:
            self._give_up(member)
            member.failure = partial(error_for, owed)
            self._ledger.fail(owed, error_for)
            return
        _log.warning("%s", str(error_for(owed)))
        # A replacement answers for steps and resets, but not for calls.
        calls = owed[~np.isin(self.slots.ops(owed), (STEP, RESET))]
        self._ledger.fail(calls, error_for)
        self._replace(member, replace(death, cause=cause), np.setdiff1d(owed, calls))

    def _give_up(self, member: Member) -> None:
        member.stage = Stage.FAILED
        member.start_by = None
        self._unavailable = True
        for slot in range(member.host.first_slot, member.host.first_slot + member.host.rows):
            self.lost.pop(slot, None)
            self.restarting.pop(slot, None)
        self._note_recovery()

    def _replace(self, member: Member, death: Death, owed: NDArray[np.intp]) -> None:
        """Start a new worker in place of a dead one, and let it answer for what was owed."""
        table, host = self.slots, member.host
        schemas: dict[int, Any] = {}
        # A new list: batches that were handed out go on reading the old one.
        table.schemas = list(table.schemas)
        for slot in range(host.first_slot, host.first_slot + host.rows):
            self.lost[slot] = death
            table.schemas[slot] = schemas
        assert member.order is not None
        try:
            self._launch(member, self._now)
        except StartFailed as fault:
            self.on_death(host, Death(f"could not be replaced: {fault}"))
            return
        host.attach(member.order)
        if len(owed):
            entries = table.renumber(owed, RESET)
            self._ledger.auto.resets_sent(owed)
            self.write_seeds(owed, np.full(len(owed), NO_SEED))
            for slot in owed.tolist():
                self.restarting[slot] = self.lost.pop(slot)
            host.request(entries)

    def note_restarted(self, slots: NDArray[np.intp], rests: dict[int, Any]) -> None:
        """Mark replies that come from a replacement; count what shows that it works."""
        for slot in slots.tolist():
            death = self.restarting.pop(slot, None)
            if death is not None:
                self._mark(slot, death, rests)
            elif self.slots.op(slot) == STEP:
                deaths = self._members[int(self.slots.host[slot])].deaths
                deaths.pop(slot, None)
                deaths.pop(NOBODY, None)
        self._note_recovery()

    def _note_recovery(self) -> None:
        self.recovering = bool(self.restarting) or any(
            member.deaths for member in self._members if member.stage is not Stage.FAILED
        )

    def _mark(self, slot: int, death: Death, rests: dict[int, Any]) -> None:
        slab = self.slabs[int(self.slots.slab[slot])]
        row = int(self.slots.row[slot])
        slab.truncated[row] = True
        slab.episode_length[row] = 0
        self.detach_info(slot, rests)
        if not isinstance(rests[slot], bytes):
            rests[slot]["info"]["worker_restarted"] = death.cause

    def detach_info(self, slot: int, rests: dict[int, Any]) -> None:
        """Decode the info of a result that is ready, while its row and schemas are there."""
        slab = self.slabs[int(self.slots.slab[slot])]
        row = int(self.slots.row[slot])
        found = rests.get(slot)
        try:
            rest: dict[str, Any] = pickle.loads(found) if isinstance(found, bytes) else found or {}
        except Exception:  # noqa: BLE001  # It may hold anything; whoever reads it learns why not.
            return
        mark = int(slab.info_mark[row])
        info: dict[str, Any] = rest.get("info", {})
        if mark not in (NO_INFO, PICKLED):
            info = self.slots.schemas[slot][mark].decode(memoryview(slab.info[row]))
        rests[slot] = {**rest, "info": dict(info)}

    # -- close --------------------------------------------------------------------

    def close(self, now: float) -> Operation[None]:
        """Close all envs; kill the workers that don't make it in time. Idempotent."""
        if self.closed:
            return
        self.closed = True
        self.open = False
        alive = [m for m in self._members if m.stage not in (Stage.NEW, Stage.CLOSED)]
        for member in alive:
            if member.stage is Stage.FAILED:
                member.stage = Stage.CLOSED
            else:
                member.host.close()
        try:
            yield from self._until_closed(alive, now + _CLOSE_SECONDS)
        finally:
            stuck = any(m.stage not in (Stage.NEW, Stage.CLOSED) for m in self._members)
            self._let_go(_KILL_SECONDS if stuck else END_SECONDS)

    def _let_go(self, seconds: float) -> None:
        for member in self._members:
            member.host.release()
        for server in self.servers:
            server.release(seconds)
        self.slabs.clear()
        self._arena.close()

    def abandon(self) -> None:
        """Let go of everything at once: the group was dropped without being closed."""
        if self.closed:
            return
        self.closed = True
        self.open = False
        started = any(m.stage is not Stage.NEW for m in self._members)
        self._let_go(END_SECONDS)
        if started:
            # The collector calls this: no caller's line would say anything.
            warnings.warn(
                "an EnvGroup was not closed; its envs were killed", ResourceWarning, stacklevel=1
            )

    def _until_closed(self, members: list[Member], by: float) -> Operation[None]:
        killed = False
        while any(m.stage is not Stage.CLOSED for m in members):
            now = yield Wait(by)
            if now < by:
                continue
            if killed:
                return  # What doesn't even die is left to the end of its fork server.
            killed, by = True, by + _KILL_SECONDS
            for member in members:
                if member.stage is not Stage.CLOSED:
                    member.host.kill(dump=False)

    def on_closed(self, host: Host, errors: list[tuple[int, ErrorText]]) -> None:
        """See `base.Inbox.on_closed`."""
        member = self._members[host.host_id]
        was_built = member.stage is not Stage.BUILDING
        member.stage = Stage.CLOSED
        # One that is killed while it starts has been told of already.
        for row, error in errors if was_built else ():
            self.close_errors.append((self.slots.env_ids[host.first_slot + row], error))
