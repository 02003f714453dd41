"""A host without a process, and a driver without a clock, for tests of the core.

The fake env's behaviour is a function of its action, so that a model can foresee it:
see `Outcome`. Its observations say which env it is and what has happened to it.
"""

from __future__ import annotations

import pickle
from asyncio import CancelledError
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium import spaces

from rlightning_aio.config import EnvConfig
from rlightning_aio.group.core import Core
from rlightning_aio.group.fleet import Fleet
from rlightning_aio.group.slots import Slots
from rlightning_aio.hosts.arena import Arena, map_shared
from rlightning_aio.hosts.base import Death
from rlightning_aio.hosts.runner import NO_ACTION
from rlightning_aio.hosts.worker import AttachOrder, ErrorText, Started
from rlightning_aio.protocol import rings
from rlightning_aio.protocol.info import NO_INFO, PICKLED
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio.group.wait import Operation

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
class Reply:
    """What goes back for one request; without `tell` it lies in the row alone."""

    entry: int
    tell: Callable[[], None] | None = None


@dataclass(eq=False)
class FakeHost:
    """See `hosts.base.Host`. Requests wait until the test has them executed (`finish`).

    Attributes:
        rung: its descriptor would be readable now.
        waiting: requests that are not executed yet, oldest first.
    """

    host_id: int
    first_slot: int
    rows: int
    arena: Arena
    inbox: Any
    inline: bool = False
    elastic: bool = False
    reads_extras: bool = False
    in_flight: int = 0
    ordered: int = 0
    rung: bool = False
    extras: dict[int, dict[str, Any]] = field(default_factory=dict)
    life: int = 0
    killed: list[bool] = field(default_factory=list)

    def fileno(self) -> int:
        raise AssertionError("nobody but a driver asks for a descriptor")

    def start(self) -> None:
        self.life += 1
        self.waiting: deque[tuple[int, Callable[[], Reply]]] = deque()
        self.unread: list[Reply] = []
        self.in_flight = self.ordered = 0
        self.rung = False
        slots = range(self.first_slot, self.first_slot + self.rows)
        self.envs = [FakeEnv(slot, self.life) for slot in slots]
        self.inbox.on_started(
            self,
            [
                Started(
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

    def attach(self, order: AttachOrder) -> None:
        (layout, rows, offset), *_ = order.slabs
        memory = map_shared(self.arena.descriptor, offset, layout.size(rows))
        self.slab = Slab(layout, memory, rows)
        self.row_of = [row for _, row in order.rows]
        self.inbox.on_attached(self)

    # -- requests

    def request(self, entries: np.ndarray) -> None:
        for entry in entries.tolist():
            row = rings.slot_of(entry) - self.first_slot
            if rings.op_of(entry) == rings.RESET:
                self._take(row, entry, lambda row=row, entry=entry: self._reset(row, entry))
            else:
                self._take(row, entry, lambda row=row, entry=entry: self._step(row, entry, None))

    def pack(self, content: Any) -> Any:
        return pickle.loads(pickle.dumps(content))

    def request_step(self, row: int, number: int, packed: Any) -> None:
        action, extras = packed
        entry = rings.entry(number, self.first_slot + row, rings.STEP)
        self.extras[self.first_slot + row] = extras
        if type(action) is str and action == NO_ACTION:
            action = None
        self._take(row, entry, lambda: self._step(row, entry, action, by_frame=True))

    def request_reset(self, row: int, number: int, packed: Any) -> None:
        entry = rings.entry(number, self.first_slot + row, rings.RESET)
        self._take(row, entry, lambda: self._reset(row, entry, by_frame=True))

    def request_call(self, row: int, number: int, packed: Any) -> None:
        name, args, _ = packed

        def call() -> Reply:
            if name == "raise":
                return self._error(row, number)
            value = (self.first_slot + row, name, args)
            return Reply(0, lambda: self.inbox.on_value(self, row, number, value))

        self._take(row, 0, call)

    def _take(self, row: int, entry: int, execute: Callable[[], Reply]) -> None:
        self.in_flight += 1
        self.waiting.append((row, execute))

    # -- what an env does

    def _step(self, row: int, entry: int, action: Any, *, by_frame: bool = False) -> Reply:
        at, number = self.row_of[row], rings.number_of(entry)
        action = int(self.slab.action[at] if action is None else action)
        if action == RAISES:
            return self._error(row, number)
        self.envs[row].step()
        info = {"told": [self.envs[row].steps]} if action == TELLS else {}
        self._write(row, float(action), action == TERMINATES, action == TRUNCATES, info)
        return self._reply(row, entry, info, by_frame=by_frame)

    def _reset(self, row: int, entry: int, *, by_frame: bool = False) -> Reply:
        self.envs[row].reset()
        seed = None if by_frame else self.slab.take_seed(self.row_of[row])
        info = {} if seed is None else {"seed": [seed]}
        self._write(row, 0.0, False, False, info)
        return self._reply(row, entry, info, by_frame=by_frame)

    def _write(
        self, row: int, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
    ) -> None:
        slab, at = self.slab, self.row_of[row]
        slab.observation[at] = self.envs[row].observation()
        slab.reward[at] = reward
        slab.terminated[at], slab.truncated[at] = terminated, truncated
        slab.info_mark[at] = PICKLED if info else NO_INFO

    def _reply(self, row: int, entry: int, info: dict[str, Any], *, by_frame: bool) -> Reply:
        if not info and not by_frame:
            return Reply(entry)
        rest = {"info": info} if info else {}
        number = rings.number_of(entry)
        return Reply(0, lambda: self.inbox.on_rest(self, row, number, rest))

    def _error(self, row: int, number: int) -> Reply:
        text = f"env {self.first_slot + row} raised"
        error = ErrorText("ValueError", text, "Traceback: as asked for\n")
        return Reply(0, lambda: self.inbox.on_error(self, row, number, error))

    # -- replies

    def finish(self, position: int = 0) -> None:
        """Execute one waiting request; its reply waits to be read."""
        _, execute = self.waiting[position]
        del self.waiting[position]
        reply = execute()
        self.unread.append(reply)
        in_rows = sum(reply.tell is None for reply in self.unread)
        # A frame makes the descriptor readable; reports do so when as many as were ordered
        # lie there, and only once for each order.
        if reply.tell is not None or (self.ordered and in_rows >= self.ordered):
            self.rung = True

    def on_readable(self) -> None:
        self.rung = False
        self.ordered = 0
        self._tell_all()

    def on_writable(self) -> None:
        raise AssertionError("never asked for")

    def order(self, count: int) -> bool:
        if count == self.ordered:
            return False
        self.ordered = count
        if sum(reply.tell is None for reply in self.unread) >= count:
            self.ordered = 0
            return True
        return False

    def withdraw(self) -> None:
        self.ordered = 0

    def unread(self) -> int:
        return 0

    def sweep(self) -> None:
        """Frames lie in the channel, which only `on_readable` reads."""
        self._tell([reply for reply in self.unread if reply.tell is None])

    def _tell_all(self) -> None:
        self._tell(list(self.unread))

    def _tell(self, replies: list[Reply]) -> None:
        self.unread = [reply for reply in self.unread if reply not in replies]
        self.in_flight -= len(replies)
        for reply in replies:
            if reply.tell is not None:
                reply.tell()
        reports = [reply.entry for reply in replies if reply.tell is None]
        if reports:
            self.inbox.on_reports(np.array(reports, np.int64))

    def run_one(self) -> bool:
        if not self.inline or not self.waiting:
            return False
        self.finish()
        self._tell_all()
        return True

    # -- ends

    def executing(self) -> tuple[int, int]:
        return 0, 0

    def kill(self, *, dump: bool) -> None:
        self.killed.append(dump)

    def die(self, cause: str = "was killed by SIGKILL") -> None:
        """The worker ends; what it had replied is heard first."""
        self._tell_all()
        self.inbox.on_death(self, Death(cause, -9))

    def close(self) -> None:
        self.waiting.clear()
        self.unread.clear()
        self.inbox.on_closed(self, [])

    def release(self) -> None:
        pass


class FakeGroup:
    """A core over fake hosts, and the clock and driver that its operations need.

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
        self.env_ids = [f"fake-{k}" for k in range(sum(rows))]
        arena = Arena()
        slots = Slots([self.config] * sum(rows), self.env_ids)
        self.fleet = Fleet(slots, arena, self, mixed_actions=False)
        self.hosts: list[FakeHost] = []
        for host_id, count in enumerate(rows):
            host = FakeHost(
                host_id,
                sum(rows[:host_id]),
                count,
                arena,
                self.fleet,
                inline=bool(inline[host_id]) if inline else False,
                reads_extras=bool(reads_extras[host_id]) if reads_extras else False,
            )
            self.hosts.append(host)
            self.fleet.add(host, self.config)
        self.core = Core(self.fleet, zero_copy=False)
        self.running: list[Running] = []
        opened = self.begin(self.fleet.start(self.now))
        assert opened.done, "fake hosts are up at once"

    def begin(self, operation: Operation[Any]) -> Running:
        """Run an operation until it has to wait; it goes on whenever the driver turns."""
        running = Running(operation)
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
                    for running in self.running:
                        running.woken = True
            woken = [r for r in self.running if r.is_due(self.now)]
            if not woken:
                self.running = [running for running in self.running if not running.done]
                return
            for running in reversed(woken) if newest_first else woken:
                running.go_on(self.now)
        raise AssertionError("the core turns in circles instead of waiting")

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.turn()

    def cancel(self, running: Running) -> None:
        with pytest.raises(CancelledError):
            running.operation.throw(CancelledError())
        running.done = True
        self.running.remove(running)
        self.turn()

    def wake(self) -> None:
        """See `hosts.base.Watcher.wake`."""
        for running in self.running:
            running.woken = True

    def host_of(self, slot: int) -> FakeHost:
        return next(h for h in self.hosts if h.first_slot <= slot < h.first_slot + h.rows)

    def finish(self, slot: int, *, newest_first: bool = False) -> None:
        """Have the request of `slot` executed, and the driver turn."""
        host = self.host_of(slot)
        rows = [row for row, _ in host.waiting]
        host.finish(rows.index(slot - host.first_slot))
        self.turn(newest_first=newest_first)

    def close(self) -> None:
        while self.running:
            self.cancel(self.running[0])
        assert self.begin(self.fleet.close(self.now)).done


class Running:
    """An operation under way."""

    def __init__(self, operation: Operation[Any]) -> None:
        self.operation = operation
        self.until: float | None = None
        self.woken = False
        self.done = False
        self.error: Exception | None = None
        self.value: Any = None

    def is_due(self, now: float) -> bool:
        return not self.done and (self.woken or (self.until is not None and now >= self.until))

    def go_on(self, now: float | None) -> None:
        self.woken = False
        try:
            self.until = self.operation.send(now).until  # type: ignore[arg-type]
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
