"""Methods and attributes of an env that the trainer calls, reads and sets by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.envs.base import BaseEnv

__all__ = ["call_env"]


def call_env(env: BaseEnv, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a method of the env, or else of the outermost wrapper that has it.

    Raises:
        AttributeError: none of them has it.
    """
    if name == "get_attr":
        return _get_attr(env, *args, **kwargs)
    if name == "set_attr":
        return _set_attr(env, *args, **kwargs)
    for layer in _layers(env):
        if hasattr(layer, name):
            return getattr(layer, name)(*args, **kwargs)
    raise AttributeError(
        f"neither env {env.env_id!r} nor its simulator, nor a wrapper around that, has {name}()"
    )


def _layers(env: BaseEnv) -> Iterator[Any]:
    """The env, its simulator's wrappers from the outermost in, and the simulator itself."""
    seen: set[int] = set()
    layer: Any = env
    while layer is not None and id(layer) not in seen:
        yield layer
        seen.add(id(layer))
        layer = getattr(layer, "env", None)
    yield _target(env, "unwrapped")


def _target(env: BaseEnv, target: str) -> Any:
    inner = env.env
    if target == "outer" or inner is None:
        return env if inner is None else inner
    if target == "unwrapped":
        return getattr(inner, "unwrapped", inner)
    raise ValueError(f"target must be 'unwrapped' or 'outer', not {target!r}")


def _get_attr(env: BaseEnv, name: str, target: str = "unwrapped") -> Any:
    return getattr(_target(env, target), name)


def _set_attr(env: BaseEnv, name: str, value: Any, target: str = "unwrapped") -> None:
    setattr(_target(env, target), name, value)
