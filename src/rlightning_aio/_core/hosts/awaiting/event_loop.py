"""The event loops that awaitable envs share, and what an env does to one: how long it holds it."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from concurrent.futures import ThreadPoolExecutor
from types import coroutine
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator
    from contextvars import Context

LONG_TURN_SECONDS: Final = 0.1
"""An env that holds the event loop for longer is reported."""
MOST_THREADS: Final = 256
"""Of the loops of `run_loop`; asyncio's own have the number of cores and four more."""
log = logging.getLogger("rlightning_aio")

T = TypeVar("T")


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
        report: gets `entry` and the seconds of each turn longer than `LONG_TURN_SECONDS`.
        enter: gets `entry` before each turn, and 0 after it.
    """
    send, throw, clock = answering.send, answering.throw, time.monotonic
    error: BaseException | None = None
    while True:
        if enter is not None:
            enter(entry)
        began = clock()
        try:
            future = send(None) if error is None else throw(error)
        except StopIteration as stop:
            return stop.value
        finally:
            if enter is not None:
                enter(0)
            if (held := clock() - began) > LONG_TURN_SECONDS:
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


def leave_behind(task: asyncio.Task[Any]) -> None:
    """Have nobody wait for a task that ignores that it is cancelled, or whose loop has ended.

    `asyncio.run` would never return, and a task that is dropped would be reported.
    """
    asyncio._unregister_task(task)  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
    setattr(task, "_log_destroy_pending", False)  # noqa: B010  # As `asyncio.gather` does.
