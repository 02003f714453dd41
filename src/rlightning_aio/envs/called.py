"""Envs whose actions are calls of the methods of an object, as those of TRL."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["called_env"]


def called_env(make: Callable[[], Any]) -> Any:
    """Return an env, which is awaitable if a method of the object is.

    Its actions are (name, arguments, keyword arguments), its observations (answer, error).

    Args:
        make: makes the object. Its `reset` gets the options as keyword arguments. What
            a method raises is an error for who called it; but if `get_reward` raises, the episode
            has failed.
    """
    made: Any = make()
    kind: Any = made.__class__
    is_awaitable = any(inspect.iscoroutinefunction(getattr(kind, name)) for name in dir(kind))
    return _Awaited(made) if is_awaitable else _Called(made)


class _Called(gym.Env[Any, Any]):
    observation_space = action_space = Anything()

    def __init__(self, made: Any) -> None:
        self._made = made

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        del seed
        return self._made.reset(**(options or {})), {}

    def step(self, action: Any) -> Any:
        name, args, kwargs = action
        try:
            found = getattr(self._made, name)(*args, **kwargs), None
        except Exception as error:  # noqa: BLE001  # For the caller.
            found = None, _message(name, error)
        return found, 0.0, False, False, {}

    def close(self) -> None:
        if hasattr(self._made, "close"):
            self._made.close()


class _Awaited:
    observation_space = action_space = Anything()

    def __init__(self, made: Any) -> None:
        self._made = made

    async def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        del seed
        return await _answer(self._made.reset(**(options or {}))), {}

    async def step(self, action: Any) -> Any:
        name, args, kwargs = action
        try:
            found = await _answer(getattr(self._made, name)(*args, **kwargs)), None
        except Exception as error:  # noqa: BLE001  # For the caller.
            found = None, _message(name, error)
        return found, 0.0, False, False, {}

    async def close(self) -> None:
        if hasattr(self._made, "close"):
            await _answer(self._made.close())


async def _answer(found: Any) -> Any:
    return await found if inspect.isawaitable(found) else found


def _message(name: str, error: Exception) -> str:
    """Return what the caller is told, or raise the error."""
    if name == "get_reward":
        raise error
    return str(error) or repr(error)
