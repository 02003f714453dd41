"""What envs do to the event loop that they share: how long they hold it, and what they leave.

`watched` awaits a coroutine and measures each of its turns, without the time of the garbage
collector, which no env has chosen. `TimeLimit` finds requests that take
too long with one timer for all envs. Tasks that an env starts belong to it, because they inherit
its context; `cancel_leftovers` finds them.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextvars import Context, ContextVar
from types import coroutine
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Coroutine, Generator, Mapping

LONG_TURN_SECONDS: Final = 0.1
"""An env that holds the event loop for longer is reported."""
MOST_THREADS: Final = 256
"""Of the loops of `run_loop`; asyncio's own have the number of cores and four more."""
OWNER: Final[ContextVar[object]] = ContextVar("rlightning_aio_env", default=None)
"""The env on whose behalf code runs, also in tasks that the env has started."""
log = logging.getLogger("rlightning_aio")

T = TypeVar("T")
F = TypeVar("F", bound=asyncio.Future[Any])


def run_loop(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a uvloop event loop.

    On asyncio's, if uvloop is missing, or ``RLIGHTNING_AIO_UVLOOP`` is 0 in the environment.
    `asyncio.to_thread` has up to `MOST_THREADS` threads there, made as they are needed, so that
    envs that wait in one don't wait for one another.
    """
    served = _served(main)
    if os.environ.get("RLIGHTNING_AIO_UVLOOP") == "0":
        return asyncio.run(served)
    try:
        import uvloop  # noqa: PLC0415  # There is none for Windows.
    except ImportError:
        return asyncio.run(served)
    return uvloop.run(served)


async def _served(main: Coroutine[Any, Any, T]) -> T:
    threads = ThreadPoolExecutor(MOST_THREADS, "to_thread")
    asyncio.get_running_loop().set_default_executor(threads)
    return await main


class _CollectorTime:
    """How long the garbage collector has run in this process; one of `gc.callbacks`.

    Attributes:
        seconds: in all.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._began = 0.0

    def __call__(self, phase: str, info: dict[str, int]) -> None:
        del info
        if phase == "start":
            self._began = time.monotonic()
        else:
            self.seconds += time.monotonic() - self._began


_collector: Final = _CollectorTime()


def time_collector() -> None:
    """Measure the garbage collector from now on, so that `watched` can leave it out. Idempotent."""
    if _collector not in gc.callbacks:
        gc.callbacks.insert(0, _collector)


@coroutine
def watched(
    answering: Coroutine[Any, Any, Any],
    entry: int,
    report: Callable[[int, float], None],
    enter: Callable[[int], object] | None,
) -> Generator[Any, Any, Any]:
    """Await `answering`.

    Args:
        answering: a coroutine that has not begun.
        entry: of the request.
        report: gets `entry` and the seconds of each turn longer than `LONG_TURN_SECONDS`; after
            `time_collector` without those of the garbage collector.
        enter: gets `entry` before each turn, and 0 after it.
    """
    send, throw, clock = answering.send, answering.throw, time.monotonic
    error: BaseException | None = None
    while True:
        if enter is not None:
            enter(entry)
        began, collected = clock(), _collector.seconds
        try:
            future = send(None) if error is None else throw(error)
        except StopIteration as stop:
            return stop.value
        finally:
            if enter is not None:
                enter(0)
            held = clock() - began - (_collector.seconds - collected)
            if held > LONG_TURN_SECONDS:
                report(entry, held)
        error = None
        try:
            yield future
        except BaseException as thrown:
            error = thrown


def new_task(
    coroutine: Coroutine[Any, Any, Any],
    loop: asyncio.AbstractEventLoop,
    context: Context | None = None,
) -> asyncio.Task[Any]:
    """Make a task that begins in a later turn of the loop, also where the loop's are eager."""
    return asyncio.Task(coroutine, loop=loop, context=context)


def awaited_calls(answering: Any) -> str:
    """Name the calls in which the env's code waits, from the outermost in."""
    frames: list[Any] = []
    while answering is not None:
        frame = getattr(answering, "cr_frame", None) or getattr(answering, "gi_frame", None)
        if frame is not None and not frame.f_globals["__name__"].startswith(
            "rlightning_aio._core.hosts"
        ):
            frames.append(frame)
        answering = getattr(answering, "cr_await", getattr(answering, "gi_yieldfrom", None))
    return " > ".join(
        f"{frame.f_code.co_qualname}, {frame.f_code.co_filename}:{frame.f_lineno}"
        for frame in frames
    )


class _Watched(Protocol):
    entry: int


class TimeLimit:
    """Calls `expire` with each env whose request takes longer than `seconds`.

    All requests have the same limit, so that the first to begin is the first whose time is up. One
    timer serves all of them. Requests whose time is up get a tenth of it in addition, and as long
    as the timer was late: while something else blocked the event loop, no env could go on.

    Args:
        seconds: the limit.
        expire: gets the env and the limit.
    """

    def __init__(self, seconds: float, expire: Callable[[Any, float], None]) -> None:
        self.seconds = seconds
        self._expire = expire
        self._running: deque[tuple[float, _Watched, int]] = deque()
        self._timer: asyncio.TimerHandle
        self._is_set = False
        self._late: dict[int, asyncio.TimerHandle] = {}
        self._num_late = 0

    def begin(self, env: _Watched, loop: asyncio.AbstractEventLoop) -> None:
        """`env` begins to execute `env.entry`, which is another one as soon as that has ended."""
        running = self._running
        while running and running[0][1].entry != running[0][2]:
            running.popleft()  # It has ended; kept until its time is up, thousands would pile up.
        running.append((time.monotonic() + self.seconds, env, env.entry))
        if not self._is_set:
            self._is_set = True
            self._timer = loop.call_later(self.seconds, self._look, loop)

    def end(self) -> None:
        """Let nothing expire any more."""
        self._running.clear()
        for timer in (*self._late.values(), *((self._timer,) if self._is_set else ())):
            timer.cancel()

    def _look(self, loop: asyncio.AbstractEventLoop) -> None:
        """Find the requests whose time is up, and when to look for the next ones."""
        self._is_set = False
        now, lateness = time.monotonic(), 0.0
        late: list[tuple[_Watched, int]] = []
        while self._running:
            expiry, env, entry = self._running[0]
            if env.entry == entry and expiry > now:
                self._is_set = True
                self._timer = loop.call_later(expiry - now, self._look, loop)
                break
            self._running.popleft()
            if env.entry == entry:
                late.append((env, entry))
                lateness = max(lateness, now - expiry)
        if late:
            self._num_late = number = self._num_late + 1
            more = self.seconds / 10 + lateness
            self._late[number] = loop.call_later(more, self._judge, number, late)

    def _judge(self, number: int, late: list[tuple[_Watched, int]]) -> None:
        del self._late[number]
        for env, entry in late:
            if env.entry == entry:
                self._expire(env, self.seconds)


async def wait_fairly(futures: Collection[F], seconds: float) -> set[F]:
    """Wait for `futures`; return those that are not done after some seconds.

    If these end late, because the event loop was blocked, it waits as long as that again.
    """
    late, more = {one for one in futures if not one.done()}, seconds
    for _ in range(2):
        if late:
            began = time.monotonic()
            late = (await asyncio.wait(late, timeout=more))[1]
            more = time.monotonic() - began - more
    return late


async def cancel(tasks: Collection[asyncio.Task[Any]], seconds: float) -> set[asyncio.Task[Any]]:
    """Cancel `tasks` and wait for them for some seconds; returns those that go on."""
    for task in tasks:
        task.cancel()
    return (await asyncio.wait(tasks, timeout=seconds))[1] if tasks else set()


def cancel_leftovers(
    names: Mapping[object, str], but: Collection[object]
) -> list[asyncio.Task[Any]]:
    """Report and cancel the tasks that closed envs have left running; return them.

    Args:
        names: the envs' names, by what `OWNER` is in their contexts.
        but: tasks that are known already.
    """
    left: dict[str, list[asyncio.Task[Any]]] = {}
    for task, owner in tasks_of(names, asyncio.get_running_loop()).items():
        if task not in but:
            left.setdefault(names[owner], []).append(task)
    for name, tasks in left.items():
        log.warning(
            "env %r left %d tasks running when it was closed (%s); they are cancelled: end them in "
            "its close()",
            name,
            len(tasks),
            ", ".join(task.get_name() for task in tasks),
        )
    found = [task for tasks in left.values() for task in tasks]
    for task in found:
        task.cancel()
    return found


def leave_behind(task: asyncio.Task[Any]) -> None:
    """Have nobody wait for a task that ignores that it is cancelled, or whose loop has ended.

    `asyncio.run` would never return, and a task that is dropped would be reported.
    """
    asyncio._unregister_task(task)  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
    setattr(task, "_log_destroy_pending", False)  # noqa: B010  # As `asyncio.gather` does.


def tasks_of(
    envs: Collection[object], loop: asyncio.AbstractEventLoop
) -> dict[asyncio.Task[Any], object]:
    """Tasks that belong to one of `envs`, with that env, except the one that runs now."""
    tasks = asyncio.all_tasks(loop) - {asyncio.current_task(loop)}
    owners = {task: _owner_of(task) for task in tasks}
    return {task: owner for task, owner in owners.items() if owner in envs}


def _owner_of(task: asyncio.Task[Any]) -> object:
    get_context: Any = getattr(task, "get_context", None)
    if get_context is not None:
        context = get_context()
    else:  # Before Python 3.12; but each task refers to its context.
        context = next((one for one in gc.get_referents(task) if type(one) is Context), None)
    return None if context is None else context.get(OWNER)
