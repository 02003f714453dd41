"""The worker side of the adapters `vector` and `sb3`, which address sub-environments one by one."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from rlightning_aio.envs.sub_envs.only_sub_env import OnlySubEnv
from rlightning_aio.envs.sub_envs.same_step import SameStep
from rlightning_aio.envs.wrappers import ClassName, autoreset_mode_of, has_wrapper
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import name_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["SEEDS", "SubEnvs", "adapted"]

_ONLY_READ: Final = ("get_wrapper_attr", "has_wrapper_attr", "render")
"""Methods without effects, which may be called on more sub-environments than requested."""
SEEDS: Final = "rlightning_aio.seeds"
"""Option of a reset: a seed for each sub-environment, if they aren't consecutive, and True if the
reset has no other options.
"""


def adapted(
    makers: Sequence[Callable[[], Any]], mode: AutoresetMode, max_episode_steps: int | None
) -> list[Callable[[], Any]]:
    """Wrap callables that make envs or vector environments, to adapt the envs in the workers.

    Args:
        makers: the user's callables.
        mode: when an env is reset after the end of its episode.
        max_episode_steps: step limit of the config entry, which an env with same-step autoreset
            must apply itself.

    Raises:
        TypeError: they are no callables, or there is one in place of one for each env.
    """
    if callable(makers):
        raise TypeError(
            f"env_fns must be a list with a callable for each env: [{name_of(makers)}] * 4, say"
        )
    for k, make in enumerate(makers):
        if not callable(make):
            raise TypeError(f"env_fns[{k}] is a {type(make).__name__}, which is not callable")
    own = {id(make): _Adapted(make, mode, max_episode_steps) for make in makers}
    return [own[id(make)] for make in makers]


class _Adapted:
    """Calls a callable that makes an env, and adapts the env."""

    def __init__(
        self, make_env: Callable[[], Any], mode: AutoresetMode, max_episode_steps: int | None
    ) -> None:
        functools.update_wrapper(self, make_env)
        self.__qualname__ = name_of(make_env)
        self._make_env, self._mode, self._limit = make_env, mode, max_episode_steps

    def __call__(self) -> Any:
        made = self._make_env()
        if not isinstance(made, gym.vector.VectorEnv):
            limited = made if self._limit is None else gym.wrappers.TimeLimit(made, self._limit)
            return SameStep(limited) if self._mode == AutoresetMode.SAME_STEP else limited
        if self._limit is not None:
            raise ConfigError(
                "max_episode_steps: a vector env keeps its own limits; set it where the envs are "
                "made"
            )
        vector = cast("gym.vector.VectorEnv[Any, Any, Any]", made)
        own = autoreset_mode_of(vector)
        if own != self._mode:
            raise ValueError(
                f"{type(vector).__name__} has autoreset_mode {own}, not {self._mode}; use the same "
                "mode for both"
            )
        return OnlySubEnv(vector) if vector.num_envs == 1 else SubEnvs(vector)


# In Gymnasium 1.2 this class takes no type parameters.
if TYPE_CHECKING:
    _Wrapper = gym.vector.VectorWrapper[Any, Any, Any, Any, Any]
else:
    _Wrapper = gym.vector.VectorWrapper


class SubEnvs(_Wrapper):
    """Wraps a vector environment: Gymnasium's, a task's, or this package's."""

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        # Bypasses this wrapper.
        self.step = env.step  # pyright: ignore[reportIncompatibleMethodOverride]
        self._inner: Any = env.unwrapped

    @property
    def takes_masks(self) -> bool:
        """True if it can reset only some of its sub-environments."""
        one_by_one = isinstance(self._inner, SyncVectorEnv | AsyncVectorEnv)
        return one_by_one or getattr(self._inner, "takes_masks", False)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the vector environment; seeds may be given in the options (`SEEDS`)."""
        if options is not None and SEEDS in options:
            options = dict(options)
            seed, is_alone = options.pop(SEEDS)
            options = None if is_alone else options
        return self.env.reset(seed=seed, options=options)

    def get_wrapper_attr(self, name: str) -> Any:
        """Get an attribute of the whole vector environment."""
        return getattr(self, name)

    def call_sub_envs(
        self, name: str, args: Sequence[Any], kwargs: dict[str, Any], which: Sequence[int] | None
    ) -> list[Any]:
        """Call a method, or get an attribute, of all sub-environments or of those in `which`.

        Raises:
            ValueError: the vector environment can call it only on all of them.
        """
        places = range(self.num_envs) if which is None else which
        some = len(set(places)) < self.num_envs and name not in _ONLY_READ
        if some or isinstance(self._inner, SyncVectorEnv):
            return [self._call_one(k, name, args, kwargs) for k in places]
        if name == "render":
            values = self.env.render()
        else:
            values = self._able_to("call")(name, *args, **kwargs)
        each = list(cast("Sequence[Any]", values))
        return [each[k] for k in places]

    def _call_one(self, k: int, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        envs: list[Any] | None = getattr(self._inner, "envs", None)  # A `SyncVectorEnv`'s.
        if envs is not None:
            found = envs[k].get_wrapper_attr(name)
            return found(*args, **kwargs) if callable(found) else found
        call_one = getattr(self._inner, "call_one", None)  # A `MujocoBatch`'s.
        if call_one is None:
            raise ValueError(
                f"{type(self._inner).__name__} can't call {name}() of only some of its "
                "sub-environments; make separate envs, each with its own callable"
            )
        return call_one(k, name, *args, **kwargs)

    def look_up_sub_env(self, place: int, name: str) -> list[tuple[bool, Any]]:
        """Look up an attribute of one sub-environment, like `GymnasiumEnv.look_up`, in a list."""
        found = self._call_one(place, "get_wrapper_attr", (name,), {})
        return [(callable(found), None if callable(found) else found)]

    def set_sub_envs(self, name: str, values: Sequence[Any]) -> None:
        """Set an attribute of each sub-environment to its own value."""
        self._able_to("set_attr")(name, list(values))

    def sub_envs_wrapped(self, name: ClassName) -> bool:
        """Return True if the class of that name is among the wrappers of the sub-environments."""
        envs: list[Any] = getattr(self._inner, "envs", [])  # A `SyncVectorEnv`'s.
        if any(has_wrapper(env, name) for env in envs):
            return True
        is_wrapped = getattr(self._inner, "is_wrapped", None)
        return False if is_wrapped is None else is_wrapped(name)

    def _able_to(self, method: str) -> Any:
        found = getattr(self._inner, method, None)
        if found is None:
            raise AttributeError(
                f"{type(self._inner).__name__} steps its sub-environments together, and has no "
                f"{method}() for each; make separate envs (vectorization_mode='async')"
            )
        return found
