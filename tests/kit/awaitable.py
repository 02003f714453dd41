"""Awaitable twins of envs, so that tests of every placement also cover `placement: loop`."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any
from unittest import mock

from rlightning_aio import ENVS
from rlightning_aio.envs.fast_path import FastPath
from rlightning_aio.registry import BACKENDS, load

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def awaitable_twins() -> Iterator[None]:
    """Build awaitable envs in all groups built in this context, whatever their backend."""
    built_in = {name: backend.target for name, backend in BACKENDS.items() if name != "env_server"}
    registered = {name: made for name in ENVS.names() if (made := ENVS.registered(name))}
    twins = {name: _Twins(made) for name, made in {**built_in, **registered}.items()}
    with mock.patch.dict(ENVS._classes, twins):
        yield


class _Twins:
    """Builds an env and makes it awaitable."""

    def __init__(self, original: Any) -> None:
        self.original = original

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        original = load(self.original) if isinstance(self.original, str) else self.original
        env = original(*args, **kwargs)
        env.__class__ = _twin(type(env))
        return env


@cache
def _twin(kind: type[Any]) -> type[Any]:
    class Twin(kind):
        async def reset(self, **kwargs: Any) -> Any:
            await asyncio.sleep(0)
            return kind.reset(self, **kwargs)

        async def step(self, policy_resp: Any) -> Any:
            await asyncio.sleep(0)
            return kind.step(self, policy_resp)

    if issubclass(kind, FastPath):
        Twin.bare_step = lambda self: None
    Twin.__module__, Twin.__qualname__ = kind.__module__, kind.__qualname__
    return Twin
