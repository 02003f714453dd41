"""The wrappers of a Gymnasium environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["wrappers_of"]


def wrappers_of(env: Any) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """Those around `env`, from the outermost in."""
    while isinstance(env, gym.Wrapper):
        yield cast("gym.Wrapper[Any, Any, Any, Any]", env)
        env = cast("Any", env).env
