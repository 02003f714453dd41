"""Hosts without a process, and a driver without a clock, for tests of the core."""

from __future__ import annotations

import pickle
from asyncio import CancelledError
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium import spaces
from kit.checked import CheckedRequests

from rlightning_aio._core.group.engine.core import Core
from rlightning_aio._core.group.engine.waiting import Poller
from rlightning_aio._core.group.state.conditions import Conditions, Lifetime, Observed
from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio._core.group.state.episodes import Episodes
from rlightning_aio._core.group.state.slab_layout import SlabLayout
from rlightning_aio._core.group.state.sums import Sums
from rlightning_aio._core.group.supervision.supervisor import Supervisor
from rlightning_aio._core.group.tables import Tables
from rlightning_aio._core.hosts.arena import Arena
from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.messages import (
    Attached,
    AttachOrder,
    Built,
    Closed,
    Completions,
    Death,
    Died,
    EnvStarted,
    Reported,
    Result,
    Value,
)
from rlightning_aio.config import EnvConfig
from rlightning_aio.protocol.entries import Operation, op_of, slot_of
from rlightning_aio.protocol.info import NO_INFO
from rlightning_aio.protocol.rings import (
    TrainerBell,
    TrainerRings,
    WorkerBell,
    WorkerRings,
    bell_size,
    rings_size,
)
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio.protocol.exchange import Ring

PLAIN = 0
"""An action."""
REFUSAL = "no more processes"
OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (4,), np.float64)
ACTION_SPACE = spaces.Discrete(5)
LAYOUT = RowLayout(OBSERVATION_SPACE, ACTION_SPACE, (), ())


@dataclass
class Shared:
    """Objects that the fake hosts of a group share."""

    completions: Completions
    arena: Arena
    bell: TrainerBell
    bell_memory: memoryview
    rings: list[Ring | None]
    num_hosts: int
    log: list[str]


class FakeHost(Host):
    """See `hosts.base.Host`. Requests wait until the test has them executed (`finish`).

    Attributes:
        waiting: index and execution of requests that are not executed yet, oldest first.
        asked: entries of all requests that have reached it.
        builds, closes: at once; otherwise not before it is killed.
        awaits: its envs are awaitable.
    """

    inline = False
    builds = closes = True
    awaits = built = closing = False

    def __init__(self, host_id: int, first_slot: int, num_envs: int, shared: Shared) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = num_envs
        self.shared = shared
        self.post = shared.completions.append
        self.rung = False
        self.asked: list[int] = []
        self.waiting: deque[tuple[int, Callable[[], None]]] = deque()

    def note(self, what: str) -> None:
        self.shared.log.append(f"{what} {self.host_id}")

    def start(self) -> None:
        self.note("start")
        self.waiting.clear()
        if self.builds:
            self.build()

    def build(self) -> None:
        self.built = True
        self.post(
            Built(
                self.host_id,
                [
                    EnvStarted(
                        EnvMeta(
                            env_id=f"fake-{slot}",
                            observation_space=OBSERVATION_SPACE,
                            action_space=ACTION_SPACE,
                        ),
                        LAYOUT,
                        reads_extras=False,
                        actions_beside_row=False,
                        is_awaitable=self.awaits,
                    )
                    for slot in range(self.first_slot, self.first_slot + self.num_envs)
                ],
            )
        )

    def attach(self, order: AttachOrder) -> None:
        self.note("attach")
        (offset, rows), *_ = order.slabs
        memory = self.shared.arena.map(offset, LAYOUT.size(rows))
        self.slab = Slab(LAYOUT, memory, rows)
        self.row_of = [row for _, row in order.rows]
        if self.built:
            self.post(Attached(self.host_id))

    # -- requests

    def packed(self, arguments: Any) -> Any:
        return pickle.loads(pickle.dumps(arguments))

    def submit(self, entries: np.ndarray, arguments: Sequence[Any] | None = None) -> None:
        assert len(entries)
        self.asked += entries.tolist()
        for position, entry in enumerate(entries.tolist()):
            given = None if arguments is None else arguments[position]
            execute = {
                Operation.STEP: self._step,
                Operation.RESET: self._reset,
                Operation.SNAPSHOT: self._snapshot,
            }[Operation(op_of(entry))]
            index = slot_of(entry) - self.first_slot
            self.waiting.append((index, lambda e=execute, k=entry, g=given: e(k, g)))

    # -- what an env does

    def _step(self, entry: int, given: Any) -> None:
        self._write(entry, is_reset=False)
        if given is None:
            self.report(entry)
        else:
            self.answer(Result(self.host_id, entry, {}))

    def _reset(self, entry: int, given: Any) -> None:
        del given
        self._write(entry, is_reset=True)
        self.report(entry)

    def _write(self, entry: int, *, is_reset: bool) -> None:
        slab, at = self.slab, self.row_of[slot_of(entry) - self.first_slot]
        slab.observation[at], slab.reward[at], slab.info_mark[at] = 0.0, 0.0, NO_INFO
        slab.terminated[at] = slab.truncated[at] = slab.over[at] = False
        slab.is_reset[at] = is_reset

    def _snapshot(self, entry: int, given: Any) -> None:
        del given
        self.answer(Value(self.host_id, entry, ({}, b"saved")))

    def report(self, entry: int) -> None:
        """Report a result that is in the row."""
        raise NotImplementedError

    def answer(self, reply: Any) -> None:
        """Send a reply that is not, or not only, in the row."""
        raise NotImplementedError

    def finish(self, position: int = 0) -> None:
        """Execute one waiting request; its reply then waits to be read."""
        _, execute = self.waiting[position]
        del self.waiting[position]
        execute()

    def on_readable(self) -> None:
        self.rung = False

    # -- ends

    def close(self) -> None:
        self.note("close")
        self.closing = True
        if self.closes:
            self.end()

    def end(self) -> None:
        self.waiting.clear()
        self.post(Closed(self.host_id, []))

    def release(self) -> None:
        self.note("release")


class FakeWorker(FakeHost):
    """See `hosts.base.Killable`. Its rings are real.

    Attributes:
        frames: unread replies.
        rung: its descriptor is readable.
        alive: it was started, and has not died since.
        dies: a kill ends it.
        refusals: number of further starts that fail.
        current: the entry that it executes, and since when (ns).
        unread: completions that wait to be read, each as a call.
    """

    on_bell = True
    alive = False
    dies = True
    refusals: float = 0
    traffic = 0
    current = (0, 0)

    def start(self) -> None:
        self.built = False
        if self.refusals:
            self.refusals -= 1
            raise OSError(REFUSAL)
        self.alive = True
        self.frames: list[Any] = []
        self.unread: list[Callable[[], object]] = []
        self.rung = False
        shared = self.shared
        memory = memoryview(bytearray(rings_size(self.num_envs)))
        self.rings = TrainerRings(memory, self.num_envs, shared.bell, self.host_id)
        shared.rings[self.host_id] = self.rings.ring(self.take_requests)
        self.bell = WorkerBell(shared.bell_memory, shared.num_hosts, self.host_id)
        self.worker_rings = WorkerRings(memory, self.num_envs, self.bell)
        assert self.worker_rings.fall_asleep()
        super().start()

    # -- the trainer's side

    def submit(self, entries: np.ndarray, arguments: Sequence[Any] | None = None) -> None:
        if arguments is not None:
            super().submit(entries, arguments)
        elif self.rings.request(entries):
            self.take_requests()

    def on_readable(self) -> None:
        self.rung = False
        while self.frames:
            self.rings.frame_seen()
            self.post(self.frames.pop(0))

    def poll(self) -> None:
        entries = self.rings.reports()
        if len(entries):
            if self.rings.has_frame():
                self.on_readable()
            self.post(Reported(self.host_id, entries))

    def current_request(self) -> tuple[int, int]:
        return self.current

    def catch_up(self) -> bool:
        found = bool(self.frames or self.unread or self.shared.bell.with_news())
        while self.unread:
            self.unread.pop(0)()
        self.on_readable()
        self.poll()
        return found

    def kill(self, *, dump: bool) -> None:
        self.note("dump and kill" if dump else "kill")
        if self.dies:
            self.end()

    def destroy(self) -> None:
        self.note("destroy")

    def end(self) -> None:
        if self.closing:
            super().end()
        else:
            self.die()

    def die(self, *requests: int) -> None:
        """End the worker, which may have executed `requests`; the host reads pending replies
        first.
        """
        self.current = (0, 0)
        self.on_readable()
        self.poll()
        self.alive = False
        self.shared.rings[self.host_id] = None
        self.waiting.clear()
        self.post(Died(self.host_id, Death("was killed by SIGKILL", -9, "last words", requests)))

    # -- the worker's side

    def take_requests(self) -> None:
        """Wake the worker, which reads the requests in its ring; a second time, there are none."""
        if entries := self.worker_rings.requests():
            super().submit(np.array(entries, np.int64))

    def report(self, entry: int) -> None:
        self.worker_rings.report(entry, self.ring)

    def ring(self) -> None:
        self.rung = True

    def answer(self, reply: Any) -> None:
        self.frames.append(reply)
        self.worker_rings.count_frame()
        self.rung = True

    def finish(self, position: int = 0) -> None:
        super().finish(position)
        if not self.waiting and self.bell.is_due():
            self.rung = True


class FakeInline(FakeHost):
    """See `hosts.base.Executing`."""

    inline = True

    def report(self, entry: int) -> None:
        self.post(Result(self.host_id, entry, {}))

    def answer(self, reply: Any) -> None:
        self.post(reply)

    def execute(self, most: int, is_over: Callable[[], bool] | None) -> int:
        count = 0
        while self.waiting and count < most:
            self.execute_one()
            count += 1
            if is_over is not None and is_over():
                break
        return count

    def execute_one(self) -> None:
        self.finish()


class FakeGroup:
    """A core over fake hosts, and the clock and driver that its procedures need.

    Args:
        rows: envs of each host.
        up: start it.
        inline: for each host, True if it is inline.
    """

    def __init__(
        self,
        rows: Sequence[int],
        inline: Sequence[bool] = (),
        *,
        up: bool = True,
        awaits: bool = False,
        **fields: Any,
    ) -> None:
        self.now = 1000.0
        self.config = EnvConfig(
            **{
                "name": "fake",
                "backend": "gymnasium",
                "task": "Fake-v0",
                "num_workers": sum(rows),
                **fields,
            }
        )
        size = sum(rows)
        self.env_ids = [f"fake-{k}" for k in range(size)]
        bell_memory = memoryview(bytearray(bell_size(len(rows))))
        bell = TrainerBell(bell_memory, len(rows))
        envs = EnvTable([self.config] * size, self.env_ids)
        conditions = self.conditions = Conditions()
        observed = Observed()
        requests = CheckedRequests(np.repeat(np.arange(len(rows)), rows), len(rows), conditions)
        layout = SlabLayout(size)
        episodes = Episodes(envs, conditions)
        lifetime = Lifetime(conditions)
        records: list[Any] = []
        tables = Tables(
            envs,
            requests,
            layout,
            episodes,
            conditions,
            observed,
            lifetime,
            Arena(),
            Sums(envs, requests, records),
            clock=lambda: self.now,
            driver=self,
            num_cores=0,
            shares_thread=True,
            records=records,
        )
        completions, arena = tables.completions, tables.arena
        supervisor = Supervisor(tables)
        poller = Poller(requests, bell, 0, clock=tables.clock)
        self.shared = shared = Shared(
            completions, arena, bell, bell_memory, requests.rings, len(rows), []
        )
        self.hosts: list[Any] = []
        for host_id, count in enumerate(rows):
            kind = FakeInline if inline and inline[host_id] else FakeWorker
            host = kind(host_id, sum(rows[:host_id]), count, shared)
            host.awaits = awaits
            self.hosts.append(host)
            supervisor.add(host, self.config)
            poller.add(host)
        self.core = Core(tables, supervisor, poller, zero_copy=False)
        self.steps = self.core.steps
        self.running: list[Running] = []
        if up:
            opened = self.begin(self.core.start(self.now))
            self.turn()
            assert opened.done, "fake hosts start at once"

    def begin(self, procedure: Procedure[Any]) -> Running:
        """Run a procedure until it waits; the driver's turns resume it."""
        running = Running(procedure)
        self.running.append(running)
        running.resume(None)
        self.turn()
        return running

    def turn(self) -> None:
        """Act as the driver until nothing is readable and no time has come."""
        for _ in range(200):
            for host in self.hosts:
                if host.rung:
                    host.on_readable()
                    self.core.apply_completions()
                    self.wake()
            woken = [r for r in self.running if r.is_due(self.now)]
            if not woken:
                self.running = [running for running in self.running if not running.done]
                return
            for running in woken:
                self.core.apply_completions()
                running.resume(self.now)
        raise AssertionError("the core loops instead of waiting")

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.turn()

    def cancel(self, running: Running) -> None:
        with pytest.raises(CancelledError):
            running.procedure.throw(CancelledError())
        running.done = True
        self.running.remove(running)
        self.turn()

    def read(self) -> None:
        """See `hosts.base.Driver`: there is nothing to read."""

    def others(self) -> str:
        """Name no other task."""
        return ""

    def wake(self) -> None:
        """See `hosts.base.Driver.wake`."""
        for running in self.running:
            running.woken = True

    def host_of(self, slot: int) -> FakeHost:
        return next(h for h in self.hosts if h.first_slot <= slot < h.first_slot + h.num_envs)

    def finish(self, slot: int) -> None:
        """Execute the request of `slot`, then let the driver act."""
        host = self.host_of(slot)
        rows = [row for row, _ in host.waiting]
        host.finish(rows.index(slot - host.first_slot))
        self.turn()

    def close(self) -> None:
        while self.running:
            self.cancel(self.running[0])
        assert self.begin(self.core.close(self.now)).done


class Running:
    """A procedure in progress."""

    def __init__(self, procedure: Procedure[Any]) -> None:
        self.procedure = procedure
        self.until: float | None = None
        self.woken = False
        self.done = False
        self.error: Exception | None = None
        self.value: Any = None

    def is_due(self, now: float) -> bool:
        # A millisecond early is not too early: all times in these tests are longer.
        due = self.until is not None and now + 1e-3 >= self.until
        return not self.done and (self.woken or due)

    def resume(self, now: float | None) -> None:
        self.woken = False
        try:
            wait = self.procedure.send(now)  # type: ignore[arg-type]
            self.until = wait.until
        except StopIteration as stop:
            self.done, self.value = True, stop.value
        except Exception as error:  # noqa: BLE001
            self.done, self.error = True, error

    def result(self) -> Any:
        """Return the result of the procedure, or raise its error."""
        assert self.done, "the procedure still waits"
        if self.error is not None:
            raise self.error
        return self.value
