"""Simulated processes, and what can happen to any of them."""

from __future__ import annotations

import asyncio
import signal
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

import greenlet

if TYPE_CHECKING:
    from collections.abc import Callable

    from simulator.world import World

__all__ = ["NOBODY", "Killed", "Living", "Nobody", "Process"]

T = TypeVar("T")


class Killed(greenlet.GreenletExit):
    """Unwinds the code of a process that has ended, when its world ends."""


class Living:
    """A simulated process, of any kind.

    Args:
        world: where it lives.
        name: for the trace.

    Attributes:
        world: as given.
        alive: it has not ended.
    """

    def __init__(self, world: World, name: str) -> None:
        self.name = name
        self.pid = next(world.pids)
        self.alive = True
        self.world = world
        self._pace = world.rng.choice((1, 1, 1, 30))
        self._is_stopped = False
        self._held: list[Callable[[], object]] = []

    def delay(self) -> float:
        """See `World.delay`; some processes are slower than others."""
        return self.world.delay() * self._pace

    def later(self, seconds: float, callback: Callable[[], object]) -> list[Any]:
        """Do something later; see `World.after`."""
        return self.world.after(seconds, partial(self._do, callback))

    def _do(self, callback: Callable[[], object]) -> None:
        if self.alive and self._is_stopped:
            self._held.append(callback)
        elif self.alive:
            callback()

    def stop(self, seconds: float) -> None:
        """Stop it for some time, as by SIGSTOP and SIGCONT."""
        self.world.counts["stops"] += 1
        self.world.note("{} is stopped for {:g} s", self.name, seconds)
        self.world.stopped.append(self)
        self._is_stopped = True
        self.world.after(seconds, self.go_on)

    def go_on(self) -> None:
        """Go on after `stop`."""
        if self._is_stopped:
            self.world.stopped.remove(self)
            self._is_stopped = False
            held, self._held = self._held, []
            for callback in held:
                self.later(0, callback)


class Process(Living):
    """A simulated process with one thread, whose code is Python's.

    Args:
        world, name: see `Living`.
        main: its program; it ends with the exit code that this returns.
        on_exit: is told its exit code, and what it has written to stderr.

    Attributes:
        stderr: what it has written there.
        descriptors: that it has open.
    """

    def __init__(
        self,
        world: World,
        name: str,
        main: Callable[[], int],
        on_exit: Callable[[int, str], object],
    ) -> None:
        super().__init__(world, name)
        self.stderr = ""
        self.descriptors: set[int] = set()
        self._main = main
        self._on_exit = on_exit
        self._greenlet = greenlet.greenlet(self._run)
        self._resumer: greenlet.greenlet
        self._is_parked = False
        self._loop: Any = None
        world.add(self)
        self._timer = self.later(world.start_delay(), self._resume)

    # -- running --------------------------------------------------------------------

    def _run(self) -> None:
        code = self._main()
        if self.alive:
            self.end(code)

    def _resume(self) -> None:
        """Run until it gives its core up, as an event of the world."""
        self._is_parked = False
        world = self.world
        world.running, self._resumer = self, greenlet.getcurrent()
        loop = asyncio._get_running_loop()
        asyncio._set_running_loop(self._loop)
        try:
            self._greenlet.switch()
        finally:
            self._loop = asyncio._get_running_loop()
            asyncio._set_running_loop(loop)
            world.running = NOBODY

    def _give_up_core(self) -> None:
        self._resumer.switch()
        if self.world.ended:
            raise Killed

    def sleep(self, seconds: float) -> None:
        """Take this long."""
        self._timer = self.later(seconds, self._resume)
        self._give_up_core()

    def wait_for(self, ready: Callable[[], T], until_ns: int | None) -> T:
        """Wait until `ready` returns something true, or until then."""
        world = self.world
        while not (found := ready()) and (until_ns is None or world.now_ns < until_ns):
            self._is_parked = True
            if until_ns is not None:
                self._timer = self.later((until_ns - world.now_ns) / 1e9, self._resume)
            self._give_up_core()
        return found

    def wake(self) -> None:
        """Let it look again at what it waits for."""
        if self._is_parked:
            self._is_parked = False
            self.world.cancel(self._timer)
            self._timer = self.later(self.delay(), self._resume)

    def unwind(self) -> None:
        """Leave all its functions, at the end of the world."""
        self.alive = False
        # Whatever is raised comes from code that would never have run on.
        if self._loop is not None:
            self._loop.set_exception_handler(lambda *_: None)
        with suppress(BaseException):
            self._greenlet.throw(Killed)
        for task in asyncio.all_tasks(self._loop) if self._loop is not None else ():
            task._log_destroy_pending = False  # pyright: ignore[reportAttributeAccessIssue]
            with suppress(BaseException):
                task.get_coro().close()
            task.get_coro().close()  # The code that cleans up may have awaited something.

    # -- faults -------------------------------------------------------------------

    def point(self) -> None:
        """Let something else happen now."""
        world, faults = self.world, self.world.faults
        chance = world.rng.random()
        if chance < faults.deaths:
            self.end(-signal.SIGKILL)
        elif chance < faults.deaths + faults.stops:
            self.stop(world.long())
        self.sleep(self.delay())

    def end(self, code: int) -> None:
        """End it; everything that it has open is closed. If it ends itself, this doesn't return."""
        world = self.world
        if not self.alive:
            return
        self.alive = False
        world.counts["deaths" if code else "exits"] += 1
        world.deaths[self.name] += code != 0
        world.note("{} ends with {}", self.name, code)
        for descriptor in self.descriptors.copy():
            world.sockets.close_descriptor(descriptor)
        self.descriptors.clear()
        self._on_exit(code, self.stderr)
        if world.running is self:
            self._give_up_core()


class Nobody:
    """Runs in events of the world, in which nothing else happens and nothing takes time."""

    def __init__(self) -> None:
        self.descriptors: set[int] = set()

    def point(self) -> None: ...

    def sleep(self, seconds: float) -> None: ...

    def wait_for(self, ready: Callable[[], T], until_ns: int | None) -> T:
        del until_ns
        return ready()


NOBODY: Final = Nobody()
