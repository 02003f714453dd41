"""The wrappers of a Gymnasium environment, found and put on, and what it says of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, cast

import gymnasium as gym
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode

from rlightning_aio.registry import is_of_simulator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from gymnasium.envs.registration import EnvSpec

ClassName: TypeAlias = tuple[str, str]
"""A class's module and qualified name. To send the class would import its module in the worker."""


def name_of(kind: type[Any]) -> ClassName:
    """Name of a class for `has_wrapper`."""
    return kind.__module__, kind.__qualname__


def has_wrapper(env: Any, name: ClassName) -> bool:
    """Return True if the class of that name, or one derived from it, is around `env`.

    Wrappers of this package, which have `hides_itself`, don't count.
    """
    wrappers = (type(wrapper) for wrapper in wrappers_of(env))
    counted = (wrapper for wrapper in wrappers if not hasattr(wrapper, "hides_itself"))
    return any(name_of(kind) == name for wrapper in counted for kind in wrapper.__mro__)


def metadata_of(env: Any) -> dict[str, Any]:
    """The metadata of an env or a vector env.

    Raises:
        TypeError: it is not a dict.
    """
    metadata = env.metadata
    if not isinstance(metadata, dict):
        raise TypeError(
            f"the metadata of {type(env.unwrapped).__name__} must be a dict, not {metadata!r}; "
            "Gymnasium's wrappers read it, too: give the class one, such as metadata = "
            "{'render_modes': []}"
        )
    return cast("dict[str, Any]", metadata)


def autoreset_mode_of(env: Any) -> AutoresetMode:
    """Autoreset mode of an env: disabled, unless it is a vector env.

    Raises:
        TypeError: the metadata is not a dict, or a vector env doesn't say it there.
    """
    metadata = metadata_of(env)
    if "autoreset_mode" in metadata or not isinstance(env, gym.vector.VectorEnv):
        return AutoresetMode(metadata.get("autoreset_mode", AutoresetMode.DISABLED))
    vector = cast("Any", env)
    name = type(vector.unwrapped).__name__
    if not hasattr(vector, "single_observation_space"):
        raise TypeError(
            f"{name} is no vector environment as Gymnasium has them since version 1.1: it has no "
            "single_observation_space and no metadata['autoreset_mode']. Use what it is made of (a "
            "PettingZoo environment with backend: pettingzoo), or write a VectorEnv around it that "
            "has both"
        )
    raise TypeError(
        f"the metadata of {name} has no autoreset_mode, which says when an env is reset after "
        "its episode. Set it in the callable, before it returns env: env.metadata = "
        "{**env.metadata, 'autoreset_mode': AutoresetMode.SAME_STEP}, or NEXT_STEP or DISABLED"
    )


def check_running(env: Any) -> None:
    """Check that a vector env is not closed.

    Raises:
        ClosedEnvironmentError: it is.
    """
    if env.closed:
        raise ClosedEnvironmentError(f"this {type(env).__name__} is closed")


def wrappers_of(env: Any) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """Yield the wrappers around `env`, from the outermost in."""
    while isinstance(env, gym.Wrapper):
        yield cast("gym.Wrapper[Any, Any, Any, Any]", env)
        env = cast("Any", env).env


class OneOf:
    """Makes one env, in wrappers, also in a worker that does not have the task registered.

    In messages it has the name of the task.

    Args:
        spec: of the task.
        kwargs: of `gymnasium.make`.
        wrappers: the first innermost.
    """

    def __init__(
        self,
        spec: EnvSpec,
        kwargs: dict[str, Any],
        wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    ) -> None:
        self._spec, self._kwargs, self._wrappers = spec, kwargs, wrappers
        self.__qualname__, self.computes = spec.id, is_of_simulator(spec)

    def __call__(self) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = gym.make(self._spec, **self._kwargs)
        for wrap in self._wrappers:
            env = wrap(env)
        return env
