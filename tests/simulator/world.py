"""`World`: one process in which the whole runtime runs over a simulated operating system.

It simulates what lies below the package, and nothing of the package: the clock, sockets, `epoll`
and event loops, processes, their deaths and signals. So the trainer's side is the real one, with
its drivers, hosts and links, and so is the code of workers. A simulated process is a greenlet. It
runs until it asks the operating system for something that takes time, or until the world takes the
core away from it at a *point*: a system call, a look at the clock, a fence between two writes to
shared memory, or the beginning or end of a function of the hot path.

One seed decides every duration, order and fault, so the same seed gives the same trace.

Why a real process can do each of these things:

- The scheduler can take the core away between any two instructions, for any time. The other
  processes then go on (`Process.point`, `World.point`).
- SIGKILL, the kernel's out-of-memory killer and crashes of native code end a process between any
  two instructions; what it wrote to shared memory and sockets before stays (`Process.end`).
- SIGSTOP, a debugger or a frozen container stop a process for any time, and it goes on as if
  nothing had happened (`Process.stop`).
- Ctrl-C reaches the trainer between any two instructions of Python (`World.point`).
"""

from __future__ import annotations

import asyncio
import gc
import heapq
import itertools
import math
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from random import Random
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

from simulator import rays
from simulator.fork_server import ForkServer, kill
from simulator.network import Network
from simulator.processes import NOBODY, Killed, Process
from simulator.sockets import Epoll, Loop, Sockets, WakeUp, run_in_process

from rlightning_aio import sharing
from rlightning_aio._core.group.drivers import sync_driver
from rlightning_aio._core.group.setup import start_orders
from rlightning_aio._core.group.supervision import hint, workers
from rlightning_aio._core.hosts import descriptors
from rlightning_aio._core.hosts.awaiting import awaited_envs
from rlightning_aio._core.hosts.process import host as process_hosts
from rlightning_aio._core.hosts.process import spares
from rlightning_aio._core.hosts.running import build_env, renewal
from rlightning_aio.envs.adapted import makers
from rlightning_aio.protocol import error_text, exchange, kernel, rings

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from simulator.processes import Living, Nobody

__all__ = ["Deadlock", "Faults", "World"]

T = TypeVar("T")

_TICK_NS: Final = 200
"""How long it takes to read the clock. So a loop that only looks at the clock ends."""
_START_NS: Final = 10**12
_EPOCH_NS: Final = 1_700_000_000 * 10**9
_MAX_EVENTS: Final = 2_000_000


class Deadlock(AssertionError):
    """The trainer waits, and nothing can happen any more."""


@dataclass(frozen=True)
class Faults:
    """How often things go wrong.

    Attributes:
        deaths: chance that a worker is killed where the world takes its core away.
        stops: chance that it is stopped there, for milliseconds up to minutes.
        interrupts: chance that the user presses Ctrl-C where the world takes the trainer's core.
        lags: chance that the trainer gets its core back late there, by milliseconds to minutes.
        starts: chance of each start that it takes long, or that the system refuses it.
        cuts: chance of a connection to an env_server to break, at each message.
        fork_servers: chance of a fork server, whenever it looks at its messages, that it is killed
            or stopped.
    """

    deaths: float = 0.0
    stops: float = 0.0
    interrupts: float = 0.0
    lags: float = 0.0
    starts: float = 0.0
    cuts: float = 0.0
    fork_servers: float = 0.0


CALM: Final = Faults()

_TRACEBACKS: Final = SimpleNamespace(
    format_exception=lambda error: ["Traceback: …\n", *traceback.format_exception_only(error)],
    format_tb=lambda _: ["Traceback: …\n"],
)
"""Does what `error_text` uses of `traceback`, without the names of files and their lines."""


class World:
    """See the module.

    Args:
        seed: decides everything.
        faults: that happen until `calm`.
        implementation: of the hot path, ``python`` or ``c``.

    Attributes:
        rng: the source of all chances; see `reseed`.
        counts: how often things happened.
        wrongs: what the package did to processes that it should not have done.
        network: between env_servers and their clients, which `Network.client` starts.
        deaths: of each process that ended with an error, by its name.
        made: how often each env was made, by the code of its first script.
        closing: codes of awaitable envs that close, and whose process they are in.
        ended: it is no more.
        stopped: processes that are stopped.
        running: whose code runs: a process's, the kernel's or a fork server's (`NOBODY`), or the
            trainer's (None).
    """

    def __init__(self, seed: int, faults: Faults = CALM, *, implementation: str = "python") -> None:
        self.rng = Random(seed)
        self.faults = self._storm = faults
        self.counts: Counter[str] = Counter()
        self.deaths: Counter[str] = Counter()
        self.made: Counter[int] = Counter()
        self.closing: set[tuple[int, Process | Nobody | None]] = set()
        self.wrongs: list[str] = []
        self.running: Process | Nobody | None = None
        self.now_ns = _START_NS
        self.sockets = Sockets(self)
        self.network = Network(self)
        self.pids = itertools.count(10_000)
        self._implementation = implementation
        self._notes: list[tuple[Any, ...]] = []
        self._events: list[list[Any]] = []
        self._order = itertools.count()
        self._num_events = 0
        self._processes: list[Process] = []
        self.stopped: list[Living] = []
        self._pieces = self.rng.choice((3, 10, 30, 100))
        self._until_point = self.rng.randrange(1, 2 * self._pieces)
        self._slowness = self.rng.choice((3e-6, 3e-5, 3e-4))
        self._cores = self.rng.choice((1, 2, 4, 8))
        self.ended = False
        self._patches = ExitStack()

    # -- life ---------------------------------------------------------------------

    def __enter__(self) -> Self:
        gc.collect()  # No garbage of another world may run any code in this one.
        if gc.isenabled():
            gc.disable()
            self._patches.callback(gc.enable)
        for target, name, replacement in self._replacements():
            self._patches.callback(setattr, target, name, getattr(target, name))
            setattr(target, name, replacement)
        self._patches.enter_context(rays.importable())
        self._patches.callback(kernel.select, kernel.selected)
        kernel.select(self._implementation)
        for name in kernel._FUNCTIONS:
            setattr(kernel, name, self._with_points(getattr(kernel, name)))
        if self._implementation == "c":
            kernel.serve = self._with_clock(kernel.serve)
        return self

    def __exit__(self, *error: object) -> None:
        self.ended, self._until_point = True, 0
        for process in self._processes:
            process.unwind()
        self._patches.close()
        self.sockets.close()

    def _replacements(self) -> list[tuple[Any, str, Any]]:
        nothing = lambda *_: 0  # noqa: E731
        nothing_known = lambda _: None  # noqa: E731
        cores = set(range(self._cores))
        scripted = sys.modules.get("simulator.scripted")
        return [
            (time, "monotonic_ns", self.clock_ns),
            (time, "monotonic", lambda: self.clock_ns() / 1e9),
            (time, "perf_counter_ns", self.clock_ns),
            (time, "perf_counter", lambda: self.clock_ns() / 1e9),
            (time, "time_ns", lambda: _EPOCH_NS + self.clock_ns()),
            (time, "time", lambda: (_EPOCH_NS + self.clock_ns()) / 1e9),
            (time, "sleep", self.sleep),
            (select, "epoll", lambda: Epoll(self)),
            (socket, "socketpair", self.sockets.pair),
            (descriptors, "WakeUp", partial(WakeUp, self.sockets)),
            (subprocess, "Popen", partial(ForkServer, self)),
            (process_hosts.ForkServerHandle, "kill", kill),
            (spares, "_spares", {}),
            (os, "close", self.sockets.close_descriptor),
            (os, "set_inheritable", self.sockets.set_inheritable),
            (os, "sched_yield", self.give_way),
            (os, "sched_getaffinity", lambda _: cores),
            (os, "sched_setaffinity", nothing),
            (sharing, "_time_limit", lambda _: None),
            (process_hosts, "processor_ns", nothing_known),
            (spares, "kill_below", nothing_known),
            (build_env, "register_tasks", nothing_known),  # The registry is this process's.
            (process_hosts, "resident_mb", lambda _: 100.0),
            (renewal, "resident_mb", lambda _: 100.0),
            # Some steps are timed by the kernel, which has a clock of its own.
            (hint, "_ENOUGH_RESULTS", math.inf),
            # Each process has a heap of its own, so these would act on one that is small.
            (gc, "collect", nothing),
            (gc, "freeze", nothing),
            (os, "fsync", nothing),
            (sync_driver, "press_again", self.press_again),
            # As on a processor that reorders accesses to memory, so that there are more fences.
            (exchange, "IN_ORDER", False),
            (rings, "IN_ORDER", False),
            (exchange, "new_fence", lambda: self.point),
            (rings, "new_fence", lambda: self.point),
            # A call that would wait for ever must be found to.
            (workers, "OWED_SECONDS", math.inf),
            (rays.MODULE, "ray", rays.SimulatedRay(self)),
            (secrets, "randbits", self.rng.getrandbits),
            # The sizes of messages decide where they are cut, so none depends on the machine.
            (error_text, "traceback", _TRACEBACKS),
            (awaited_envs, "awaited_calls", lambda _: "calls"),
            (start_orders, "StartOrder", partial(start_orders.StartOrder, trainer_pid=1)),
            *self.network.replacements(),
            (awaited_envs, "run_loop", lambda main: run_in_process(self, main)),
            *([(scripted, "machine", SimulatedMachine(self))] if scripted else []),
        ]

    def _with_points(self, function: Callable[..., T]) -> Callable[..., T]:
        def called(*arguments: Any) -> T:
            self.point()
            found = function(*arguments)
            self.point()
            return found

        return called

    def _with_clock(self, serve: Callable[..., bool]) -> Callable[..., bool]:
        """Have the compiled `serve`, which asks the machine for the time, publish the world's."""

        def called(side: Any, execute: Any, finish: Any, ring: Any, *arguments: Any) -> bool:
            receive, steps, *rest = arguments

            def timed(function: Callable[..., Any], *entry: int) -> Any:
                side.words[exchange.CURRENT_SINCE_NS] = self.clock_ns()
                return function(*entry)

            # Looked up when it is called, because a rebuilt env has another.
            own = [lambda k=k: timed(steps[k]) for k in range(len(steps))]
            return serve(side, partial(timed, execute), finish, ring, receive, own, *rest)

        return called

    def run(self, main: Coroutine[Any, Any, T]) -> T:
        """Run a program on an event loop of the world."""
        with asyncio.Runner(debug=False, loop_factory=lambda: Loop(self)) as runner:
            return runner.run(main)

    def calm(self) -> None:
        """Let nothing go wrong from now on; what is stopped goes on."""
        self.note("calm")
        self.faults = CALM
        for stopped in list(self.stopped):
            stopped.go_on()

    def storm(self) -> None:
        """Let things go wrong again."""
        self.faults = self._storm

    def reseed(self, seed: int) -> None:
        """Let `seed` alone decide what happens from now on."""
        self.rng.seed(seed)
        self._until_point = self.rng.randrange(1, 2 * self._pieces)

    # -- what happened ------------------------------------------------------------

    @property
    def trace(self) -> list[str]:
        """What happened, a line each, with the time in seconds."""
        return [
            f"{(at - _START_NS) / 1e9:.6f} {what.format(*args)}" for at, what, *args in self._notes
        ]

    @property
    def hours(self) -> float:
        """Simulated hours."""
        return (self.now_ns - _START_NS) / 3.6e12

    def note(self, what: str, *args: object) -> None:
        """Add a line to the trace, with `args` in the places that `what` has for them."""
        self._notes.append((self.now_ns, what, *args))

    # -- the clock, and what happens ------------------------------------------------

    def clock_ns(self) -> int:
        """Return the time."""
        self.point()
        self.now_ns += _TICK_NS
        return self.now_ns

    def delay(self) -> float:
        """Draw how long something takes that takes no time for its own sake, in seconds."""
        return self.rng.expovariate(1 / self._slowness)

    def long(self) -> float:
        """Draw how long something takes that goes wrong, in seconds."""
        return self.rng.choice((1e-3, 0.03, 1.0, 30.0, 400.0))

    def refuses(self) -> bool:
        """Draw if the system refuses to start something."""
        refuses = self.rng.random() < self.faults.starts / 2
        self.counts["refusals"] += refuses
        return refuses

    def start_delay(self) -> float:
        """Draw how long a start takes, in seconds."""
        if self.rng.random() < self.faults.starts:
            self.counts["slow starts"] += 1
            return self.long()
        return self.delay()

    def after(self, seconds: float, callback: Callable[[], object]) -> list[Any]:
        """Call `callback` at a later time; `cancel` takes what this returns."""
        event = [self.now_ns + int(seconds * 1e9), next(self._order), callback]
        heapq.heappush(self._events, event)
        return event

    @staticmethod
    def cancel(event: list[Any]) -> None:
        """Let something not happen."""
        event[2] = None

    def happen(self, until_ns: int | None) -> bool:
        """Let the next thing happen; False if nothing is left to happen by then."""
        while self._events:
            if until_ns is not None and self._events[0][0] > until_ns:
                return False
            self._count_event()
            at, _, callback = heapq.heappop(self._events)
            if callback is not None:
                self.now_ns = max(self.now_ns, at)
                self.running = NOBODY
                try:
                    callback()
                finally:
                    self.running = None
                return True
        return False

    def _count_event(self) -> None:
        """Count what happens, and what the trainer does: a program that goes on and on must fail.

        Raises:
            Deadlock: it is more than any program needs.
        """
        self._num_events += 1
        if self._num_events > _MAX_EVENTS:
            self._num_events = 0  # Now the program is closed.
            raise Deadlock(f"{_MAX_EVENTS} events have led to nothing")

    def sleep(self, seconds: float) -> None:
        """Take this long, in the trainer or in a process."""
        if self.running is not None:
            self.running.sleep(seconds)
            return
        until = self.now_ns + int(seconds * 1e9)
        while self.happen(until):
            pass
        self.now_ns = max(self.now_ns, until)

    def wait_for(self, ready: Callable[[], T], seconds: float | None) -> T:
        """Wait until `ready` returns something true, for at most some seconds.

        Raises:
            Deadlock: the trainer waits, and nothing can happen any more.
        """
        if self.ended:
            raise Killed
        until = None if seconds is None else self.now_ns + max(0, int(seconds * 1e9))
        if self.running is not None:
            return self.running.wait_for(ready, until)
        self._count_event()
        self.sleep(1e-6)  # A system call takes time, so a loop of calls that don't wait ends.
        while not (found := ready()):
            if not self.happen(until):
                if until is None:
                    raise Deadlock("the trainer waits, and nothing can happen any more")
                self.now_ns = max(self.now_ns, until)
                return ready()
        if self.rng.random() < 0.3:  # It wakes up late.
            self.sleep(self.delay())
            found = ready()
        return found

    def give_way(self) -> None:
        """Let others have the core, as by `sched_yield`."""
        self.sleep(5e-6 if self.rng.random() < 0.9 else self.delay())

    # -- faults -------------------------------------------------------------------

    def point(self, *, interruptible: bool = True) -> None:
        """Let something else happen here, now and then."""
        self._until_point -= 1
        if self._until_point > 0:
            return
        if self.ended:
            raise Killed
        self._until_point = self.rng.randrange(1, 2 * self._pieces)
        if self.running is not None:
            self.running.point()
            return
        self._count_event()
        chance, faults = self.rng.random(), self.faults
        if chance < faults.lags:
            self.counts["lags"] += 1
            self.sleep(self.long())
        else:
            self.sleep(self.delay())
        if interruptible and chance > 1 - faults.interrupts:
            self.interrupt()

    def interrupt(self) -> None:
        """Press Ctrl-C; again only after the next `storm`, as a second one may break a group."""
        self.faults = replace(self.faults, interrupts=0.0)
        self.counts["interrupts"] += 1
        self.note("Ctrl-C")
        self.running = None  # The trainer handles it.
        signal.raise_signal(signal.SIGINT)

    def press_again(self) -> None:
        """Note that Ctrl-C comes again, after the call that held it back has returned."""
        self.note("Ctrl-C comes again")
        self.counts["interrupts again"] += 1

    def add(self, process: Process) -> None:
        """Keep a process until the end."""
        self._processes.append(process)

    def kill(self, pids: Sequence[int | None]) -> None:
        """Kill processes, as a user does."""
        for process in self._processes:
            if process.pid in pids:
                process.end(-signal.SIGKILL)


class SimulatedMachine:
    """See `scripted.Machine`, of which it takes the place."""

    def __init__(self, world: World) -> None:
        self._world = world

    def spend(self, seconds: float) -> None:
        self._world.sleep(seconds)

    def die(self, how: str) -> None:
        process, world = self._process(), self._world
        end = partial(process.end, 3 if how == "exit" else -signal.SIGKILL)
        if how == "soon":
            world.after(world.rng.randrange(4) * world.delay(), end)
        else:
            end()

    def hang(self) -> None:
        self._process().wait_for(lambda: False, None)

    def _process(self) -> Process:
        process = self._world.running
        assert isinstance(process, Process), "an env in the trainer's process can't die or hang"
        return process

    def make(self, code: int) -> None:
        """Check that the env can know whether it takes the place of another."""
        made, running = self._world.made, self._world.running
        told = makers.RESTARTS in os.environ
        # Of others: a client's env is made by the program, and an actor knows of none before it.
        is_workers = isinstance(running, Process) and not isinstance(running, rays.Actor)
        if told > made[code] or (is_workers and told != bool(made[code])):
            self._world.wrongs.append(f"{code} was made {made[code]} times, and is told {told}")
        made[code] += 1
        if (code, self._world.running) in self._world.closing:
            self._world.wrongs.append(f"{code} is made while the one before still closes")

    def closing(self, code: int, *, ends: bool) -> None:
        closing, one = self._world.closing, (code, self._world.running)
        closing.discard(one) if ends else closing.add(one)

    async def await_for(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def await_for_ever(self) -> None:
        await asyncio.Event().wait()
