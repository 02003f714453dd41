"""One code for both kinds of groups: procedures, run with or without ``await``.

A procedure is a generator that yields functions to call, and is sent their results. One coroutine
runs it. With a synchronous group nothing in it is awaited, so it ends at its first step.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, TypeVar

from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup

T = TypeVar("T")

Procedure: TypeAlias = Generator[Callable[[], Any], Any, T]
"""Yields functions to call, is sent their results (awaited if awaitable), returns its result."""


def run(procedure: Procedure[Any], group: AsyncEnvGroup | SyncEnvGroup) -> Any:
    """Run `procedure` to its end: synchronously, or as a coroutine if `group` is asynchronous.

    Raises:
        TypeError: `group` is synchronous, and a call must be awaited.
    """
    awaits = isinstance(group, AsyncEnvGroup)
    running = _run(procedure, awaits=awaits)
    if awaits:
        return running
    try:
        running.send(None)
    except StopIteration as end:
        return end.value
    raise AssertionError("nothing is awaited")


async def _run(procedure: Procedure[T], *, awaits: bool) -> T:
    """Run `procedure` to its end; awaitable results of calls are awaited, or refused."""
    try:
        call = next(procedure)
        while True:
            try:
                value = call()
                if hasattr(value, "__await__"):
                    if not awaits:
                        _refuse(value)
                    value = await value
            except BaseException as error:
                call = procedure.throw(error)
            else:
                call = procedure.send(value)
    except StopIteration as stop:
        return stop.value


def _refuse(value: Any) -> NoReturn:
    if inspect.iscoroutine(value):
        value.close()
    raise TypeError(
        "a policy that is a coroutine function needs an asynchronous group: "
        "rlightning_aio.build_env_group, not rlightning_aio.sync's"
    )
