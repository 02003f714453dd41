"""Methods and attributes of an env that the trainer calls, reads and sets by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.envs.base import BaseEnv


def call_env(env: BaseEnv, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a method of the env, or else of the outermost wrapper that has it.

    Raises:
        AttributeError: none of them has it.
    """
    if name == "get_attr":
        return _get_attr(env, *args, **kwargs)
    if name == "set_attr":
        return _set_attr(env, *args, **kwargs)
    return getattr(_layer_with(env, name, f"{name}()"), name)(*args, **kwargs)


def _layer_with(env: BaseEnv, name: str, words: str) -> Any:
    for layer in _layers(env):
        if hasattr(layer, name):
            return layer
    raise AttributeError(
        f"neither env {env.env_id!r} nor its simulator, nor a wrapper around that, has {words}"
    )


def _layers(env: BaseEnv) -> Iterator[Any]:
    """The env, its simulator's wrappers from the outermost in, and the simulator itself."""
    seen: set[int] = set()
    layer: Any = env
    while layer is not None and id(layer) not in seen:
        yield layer
        seen.add(id(layer))
        layer = getattr(layer, "env", None)
    yield _simulator(env)


def _simulator(env: BaseEnv) -> Any:
    return env if env.env is None else getattr(env.env, "unwrapped", env.env)


def _get_attr(env: BaseEnv, name: str) -> Any:
    return getattr(_layer_with(env, name, name), name)


def _set_attr(env: BaseEnv, name: str, value: Any) -> None:
    owner = next((layer for layer in _layers(env) if hasattr(layer, name)), _simulator(env))
    setattr(owner, name, value)
