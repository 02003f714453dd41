"""One code for both kinds of groups: procedures, run with or without ``await``.

A procedure is a generator that yields functions to call, and is sent their results. Only the two
functions that run it differ between asynchronous and synchronous groups.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup

T = TypeVar("T")

Procedure: TypeAlias = Generator[Callable[[], Any], Any, T]
"""Yields functions to call, is sent their results (awaited if awaitable), returns its result."""


def run(procedure: Procedure[Any], group: AsyncEnvGroup | SyncEnvGroup) -> Any:
    """Run `procedure` to its end: synchronously, or as a coroutine if `group` is asynchronous."""
    if isinstance(group, AsyncEnvGroup):
        return _awaited(procedure)
    return _called(procedure)


def _called(procedure: Procedure[T]) -> T:
    """Run `procedure` to its end, synchronously.

    Raises:
        TypeError: a call must be awaited.
    """
    try:
        call = next(procedure)
        while True:
            try:
                value = call()
                if hasattr(value, "__await__"):
                    _discard(value)
                    raise TypeError(
                        "a policy that is a coroutine function needs an asynchronous group: "
                        "rlightning_aio.build_env_group, not rlightning_aio.sync's"
                    )
            except BaseException as error:
                call = procedure.throw(error)
            else:
                call = procedure.send(value)
    except StopIteration as stop:
        return stop.value


def _discard(value: Any) -> None:
    if inspect.iscoroutine(value):
        value.close()


async def _awaited(procedure: Procedure[T]) -> T:
    """Run `procedure` to its end, and await awaitable results of calls."""
    try:
        call = next(procedure)
        while True:
            try:
                value = call()
                if hasattr(value, "__await__"):
                    value = await value
            except BaseException as error:
                call = procedure.throw(error)
            else:
                call = procedure.send(value)
    except StopIteration as stop:
        return stop.value
