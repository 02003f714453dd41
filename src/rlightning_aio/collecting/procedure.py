"""How a collector waits: with ``await`` over an asynchronous group, without over the other.

A procedure is a generator that yields what is to be called, and is sent what came of it. So each
rule exists once; two functions here are all that differs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from rlightning_aio.group.aio import EnvGroup as AsyncEnvGroup

__all__ = ["Procedure", "run"]

if TYPE_CHECKING:
    from rlightning_aio.group.sync import EnvGroup as SyncEnvGroup

T = TypeVar("T")

Procedure: TypeAlias = Generator[Callable[[], Any], Any, T]
"""Yields calls, is sent their values (of coroutines: what they return), returns its result."""


def run(procedure: Procedure[Any], group: AsyncEnvGroup | SyncEnvGroup) -> Any:
    """Run `procedure` to its end: now, or as a coroutine if `group` is asynchronous."""
    return _awaited(procedure) if isinstance(group, AsyncEnvGroup) else _called(procedure)


def _called(procedure: Procedure[T]) -> T:
    """Run `procedure` to its end.

    Raises:
        TypeError: a call must be awaited.
    """
    try:
        call = next(procedure)
        while True:
            try:
                value = call()
                if inspect.isawaitable(value):
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
    """Run `procedure` to its end; what a call returns is awaited where it can be."""
    try:
        call = next(procedure)
        while True:
            try:
                value = call()
                if inspect.isawaitable(value):
                    value = await value
            except BaseException as error:
                call = procedure.throw(error)
            else:
                call = procedure.send(value)
    except StopIteration as stop:
        return stop.value
