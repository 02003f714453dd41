"""Hosts without a process, and a driver without a clock, for tests of the core.

The fake env's behaviour is a function of its action, so that a model can foresee it.
Its observations say which env it is and what has happened to it.
"""

from __future__ import annotations

import pickle
from asyncio import CancelledError
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium import spaces

from rlightning_aio.config import EnvConfig
from rlightning_aio.group.core import Core
from rlightning_aio.group.env_table import EnvTable
from rlightning_aio.group.poller import Poller
from rlightning_aio.group.requests import Requests
from rlightning_aio.group.resumption import Resumption
from rlightning_aio.group.slab_layout import SlabLayout
from rlightning_aio.group.supervisor import Supervisor
from rlightning_aio.hosts.arena import Arena, map_shared
from rlightning_aio.hosts.messages import (
    NO_ACTION,
    Attached,
    AttachOrder,
    Built,
    Closed,
    Completions,
    Death,
    Died,
    EnvStarted,
    ErrorText,
    Raised,
    Reported,
    Result,
    Value,
)
from rlightning_aio.protocol.bell import TrainerBell, WorkerBell, bell_size
from rlightning_aio.protocol.entries import Operation, op_of, slot_of
from rlightning_aio.protocol.info import NO_INFO, PICKLED
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio.group.wait import Procedure

PLAIN, TERMINATES, TRUNCATES, RAISES, TELLS = range(5)
"""What an action does: nothing more, end the episode, raise, bring an info by frame."""

OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (4,), np.float64)
ACTION_SPACE = spaces.Discrete(5)
LAYOUT = RowLayout(OBSERVATION_SPACE, ACTION_SPACE, (), ())


@dataclass
class FakeEnv:
    """What one env does; the model keeps one of its own to foresee it.

    Attributes:
        identity: its slot in the group.
        life: how often its worker was started.
        requests: executed in this life; steps: since the reset, or -1 before the first.
    """

    identity: int
    life: int = 1
    requests: int = 0
    steps: int = -1

    def observation(self) -> np.ndarray:
        return np.array([self.identity, self.life, self.requests, self.steps], np.float64)

    def reset(self) -> None:
        self.requests += 1
        self.steps = 0

    def step(self) -> None:
        self.requests += 1
        self.steps += 1


@dataclass
class Shared:
    """What the fake hosts of a group have in common."""

    completions: Completions
    arena: Arena
    bell: TrainerBell
    bell_memory: memoryview
    num_hosts: int


class FakeHost:
    """See `hosts.base.Host`. Requests wait until the test has them executed (`finish`).

    Attributes:
        waiting: index and execution of requests that are not executed yet, oldest first.
        extras: by slot, what came beside its last step.
        life: how often it was started.
    """

    inline = False

    def __init__(
        self, host_id: int, first_slot: int, num_envs: int, shared: Shared, *, reads_extras: bool
    ) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = num_envs
        self.shared = shared
        self.tell = shared.completions.append
        self.reads_extras = reads_extras
        self.extras: dict[int, dict[str, Any]] = {}
        self.life = 0
        self.rung = False

    def start(self) -> None:
        self.life += 1
        self.waiting: deque[tuple[int, Callable[[], None]]] = deque()
        slots = range(self.first_slot, self.first_slot + self.num_envs)
        self.envs = [FakeEnv(slot, self.life) for slot in slots]
        self.tell(
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
                        reads_extras=self.reads_extras,
                        transforms_actions=False,
                    )
                    for slot in slots
                ],
            )
        )

    def attach(self, order: AttachOrder) -> None:
        (offset, rows), *_ = order.slabs
        memory = map_shared(self.shared.arena.descriptor, offset, LAYOUT.size(rows))
        self.slab = Slab(LAYOUT, memory, rows)
        self.row_of = [row for _, row in order.rows]
        self.tell(Attached(self.host_id))

    # -- requests

    def packed(self, arguments: Any) -> Any:
        return pickle.loads(pickle.dumps(arguments))

    def submit(self, entries: np.ndarray, arguments: Sequence[Any] | None = None) -> None:
        for position, entry in enumerate(entries.tolist()):
            given = None if arguments is None else arguments[position]
            execute = {
                Operation.STEP: self._step,
                Operation.RESET: self._reset,
                Operation.CALL: self._call,
            }[Operation(op_of(entry))]
            index = slot_of(entry) - self.first_slot
            self.waiting.append((index, lambda e=execute, k=entry, g=given: e(k, g)))

    # -- what an env does

    def _step(self, entry: int, given: Any) -> None:
        index = slot_of(entry) - self.first_slot
        at = self.row_of[index]
        action = self.slab.action[at]
        if given is not None:
            self.extras[slot_of(entry)] = given[1]
            if not (type(given[0]) is str and given[0] == NO_ACTION):
                action = given[0]
        action = int(action)
        if action == RAISES:
            self._raise(entry)
            return
        self.envs[index].step()
        info = {"told": [self.envs[index].steps]} if action == TELLS else {}
        self._write(index, float(action), action == TERMINATES, action == TRUNCATES, info)
        self.slab.is_reset[at] = False
        self.slab.over[at] |= action in (TERMINATES, TRUNCATES)
        self._reply(entry, info, out_of_band=given is not None)

    def _reset(self, entry: int, given: Any) -> None:
        index = slot_of(entry) - self.first_slot
        at = self.row_of[index]
        self.envs[index].reset()
        seed = None if given is not None else self.slab.take_seed(at)
        info = {} if seed is None else {"seed": [seed]}
        self._write(index, 0.0, False, False, info)
        self.slab.is_reset[at] = True
        self.slab.over[at] = False
        self._reply(entry, info, out_of_band=given is not None)

    def _write(
        self, index: int, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
    ) -> None:
        slab, at = self.slab, self.row_of[index]
        slab.observation[at] = self.envs[index].observation()
        slab.reward[at] = reward
        slab.terminated[at], slab.truncated[at] = terminated, truncated
        slab.info_mark[at] = PICKLED if info else NO_INFO

    def _reply(self, entry: int, info: dict[str, Any], *, out_of_band: bool) -> None:
        if info or out_of_band:
            self.answer(Result(self.host_id, entry, {"info": info} if info else {}))
        else:
            self.report(entry)

    def _raise(self, entry: int) -> None:
        text = f"env {slot_of(entry)} raised"
        error = ErrorText("ValueError", text, "Traceback: as asked for\n")
        self.answer(Raised(self.host_id, entry, error))

    def _call(self, entry: int, given: Any) -> None:
        name, args, _ = given
        if name == "raise":
            self._raise(entry)
        else:
            self.answer(Value(self.host_id, entry, (slot_of(entry), name, args)))

    def report(self, entry: int) -> None:
        """The result lies in the row."""
        raise NotImplementedError

    def answer(self, told: Any) -> None:
        """The result, or a part of it, does not."""
        raise NotImplementedError

    def finish(self, position: int = 0) -> None:
        """Execute one waiting request; its reply waits to be read."""
        _, execute = self.waiting[position]
        del self.waiting[position]
        execute()

    def on_readable(self) -> None:
        self.rung = False

    # -- ends

    def close(self) -> None:
        self.waiting.clear()
        self.tell(Closed(self.host_id, []))

    def release(self) -> None:
        pass


class FakeWorker(FakeHost):
    """See `hosts.base.Polled` and `Killable`.

    Attributes:
        reports, frames: replies that nobody has read.
        rung: its descriptor would be readable now.
        killed: whether with a dump, for each time.
        alive: it was started, and has not died since.
        refusals: so many more starts fail.
    """

    alive = False
    refusals = 0
    traffic = 0

    def start(self) -> None:
        if self.refusals:
            self.refusals -= 1
            raise OSError("no more processes")
        self.alive = True
        self.reports: list[int] = []
        self.frames: list[Any] = []
        self.killed: list[bool] = []
        self.rung = False
        self.count = 0
        shared = self.shared
        shared.bell.restart(self.host_id)
        self.bell = WorkerBell(shared.bell_memory, shared.num_hosts, self.host_id)
        super().start()

    def report(self, entry: int) -> None:
        self.reports.append(entry)
        self.count += 1
        if self.bell.publish(self.count) and self.bell.is_due():
            self.rung = True

    def answer(self, told: Any) -> None:
        self.frames.append(told)
        self.rung = True

    def finish(self, position: int = 0) -> None:
        super().finish(position)
        if not self.waiting and self.bell.is_due():
            self.rung = True

    def on_readable(self) -> None:
        self.rung = False
        while self.frames:
            self.tell(self.frames.pop(0))
        self.poll()

    def poll(self) -> None:
        """Frames lie in the channel, which only `on_readable` reads."""
        if self.reports:
            self.tell(Reported(self.host_id, np.array(self.reports, np.int64)))
            self.shared.bell.took(self.host_id, len(self.reports))
            self.reports.clear()

    def executing(self) -> tuple[int, int]:
        return 0, 0

    def catch_up(self) -> bool:
        found = bool(self.frames or self.reports)
        self.on_readable()
        return found

    def kill(self, *, dump: bool) -> None:
        self.killed.append(dump)

    def destroy(self) -> None:
        raise NotImplementedError("a kill is all it takes")

    def die(self, cause: str = "was killed by SIGKILL") -> None:
        """The worker ends; what it had replied is heard first."""
        self.on_readable()
        self.alive = False
        self.waiting.clear()
        self.tell(Died(self.host_id, Death(cause, -9)))


class FakeInline(FakeHost):
    """See `hosts.base.Executing`."""

    inline = True

    def report(self, entry: int) -> None:
        self.tell(Result(self.host_id, entry, {}))

    def answer(self, told: Any) -> None:
        self.tell(told)

    def execute_next(self) -> bool:
        if not self.waiting:
            return False
        self.finish()
        return True

    def poll(self) -> None:
        """All of it is told at once."""


class FakeGroup:
    """A core over fake hosts, and the clock and driver that its procedures need.

    Args:
        rows: envs of each host.
        inline: for each host whether it is inline; reads_extras likewise.
    """

    def __init__(
        self,
        rows: Sequence[int],
        inline: Sequence[bool] = (),
        reads_extras: Sequence[bool] = (),
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
        completions: Completions = deque()
        arena = Arena()
        bell_memory = memoryview(bytearray(bell_size(len(rows))))
        bell = TrainerBell(bell_memory, len(rows))
        envs = EnvTable([self.config] * size, self.env_ids)
        requests = Requests(np.repeat(np.arange(len(rows)), rows), len(rows))
        layout = SlabLayout(size)
        resumption = Resumption(requests)
        supervisor = Supervisor(
            envs,
            requests,
            layout,
            resumption,
            arena,
            completions.append,
            mixed_actions=False,
            num_cores=0,
            clock=lambda: self.now,
        )
        poller = Poller(requests, bell, 0, clock=lambda: self.now)
        shared = Shared(completions, arena, bell, bell_memory, len(rows))
        self.hosts: list[Any] = []
        for host_id, count in enumerate(rows):
            kind = FakeInline if inline and inline[host_id] else FakeWorker
            reads = bool(reads_extras[host_id]) if reads_extras else False
            host = kind(host_id, sum(rows[:host_id]), count, shared, reads_extras=reads)
            self.hosts.append(host)
            supervisor.add(host, self.config)
            poller.add(host)
        self.core = Core(
            envs,
            requests,
            layout,
            resumption,
            supervisor,
            poller,
            completions,
            self,
            zero_copy=False,
        )
        self.running: list[Running] = []
        opened = self.begin(self.core.start(self.now))
        self.turn()
        assert opened.done, "fake hosts are up at once"

    def begin(self, procedure: Procedure[Any]) -> Running:
        """Run a procedure until it has to wait; it goes on whenever the driver turns."""
        running = Running(procedure)
        self.running.append(running)
        running.go_on(None)
        self.turn()
        return running

    def turn(self, *, newest_first: bool = False) -> None:
        """What a driver does until nothing is readable and no time has come."""
        for _ in range(200):
            for host in self.hosts:
                if host.rung:
                    host.on_readable()
                    self.core.drain()
                    for running in self.running:
                        running.woken = True
            woken = [r for r in self.running if r.is_due(self.now)]
            if not woken:
                self.running = [running for running in self.running if not running.done]
                return
            for running in reversed(woken) if newest_first else woken:
                self.core.drain()
                running.go_on(self.now)
        raise AssertionError("the core turns in circles instead of waiting")

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.turn()

    def cancel(self, running: Running) -> None:
        with pytest.raises(CancelledError):
            running.procedure.throw(CancelledError())
        running.done = True
        self.running.remove(running)
        self.turn()

    def wake(self) -> None:
        """See `hosts.base.Watcher.wake`."""
        for running in self.running:
            running.woken = True

    def host_of(self, slot: int) -> FakeHost:
        return next(h for h in self.hosts if h.first_slot <= slot < h.first_slot + h.num_envs)

    def finish(self, slot: int, *, newest_first: bool = False) -> None:
        """Have the request of `slot` executed, and the driver turn."""
        host = self.host_of(slot)
        rows = [row for row, _ in host.waiting]
        host.finish(rows.index(slot - host.first_slot))
        self.turn(newest_first=newest_first)

    def close(self) -> None:
        while self.running:
            self.cancel(self.running[0])
        assert self.begin(self.core.close(self.now)).done


class Running:
    """A procedure under way."""

    def __init__(self, procedure: Procedure[Any]) -> None:
        self.procedure = procedure
        self.until: float | None = None
        self.woken = False
        self.done = False
        self.error: Exception | None = None
        self.value: Any = None

    def is_due(self, now: float) -> bool:
        # A look a millisecond later is as good as now: no time that matters here is shorter.
        due = self.until is not None and now + 1e-3 >= self.until
        return not self.done and (self.woken or due)

    def go_on(self, now: float | None) -> None:
        self.woken = False
        try:
            self.until = self.procedure.send(now).until  # type: ignore[arg-type]
        except StopIteration as stop:
            self.done, self.value = True, stop.value
        except Exception as error:  # noqa: BLE001
            self.done, self.error = True, error

    def result(self) -> Any:
        """What it has returned; raises what it has raised."""
        assert self.done, "it still waits"
        if self.error is not None:
            raise self.error
        return self.value
