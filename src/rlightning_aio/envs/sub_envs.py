"""What the adapters `vector` and `sb3` have of an env in its worker: their far end.

To them the sub-environments of all vector environments are one row of envs, and are spoken to one
by one.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from rlightning_aio.envs.same_step import SameStep
from rlightning_aio.envs.wrappers import wrappers_of
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["SEEDS", "SubEnvs", "adapted"]

_ONLY_READ: Final = ("get_wrapper_attr", "has_wrapper_attr", "render")
"""What may be asked of more sub-environments than was wished for."""
SEEDS: Final = "rlightning_aio.seeds"
"""Among the options of a reset: seeds that don't follow one another, one for each."""


def adapted(
    makers: Sequence[Callable[[], Any]], mode: AutoresetMode, max_episode_steps: int | None
) -> list[Callable[[], Any]]:
    """`makers`, each of an env or a vector environment, as an adapter has them in its workers.

    Args:
        makers: of the user's.
        mode: what each env does after its episode's end.
        max_episode_steps: which cuts an episode, where an entry says that. An env that is reset
            in the same step must know of it.
    """
    own = {id(make): _Adapted(make, mode, max_episode_steps) for make in makers}
    return [own[id(make)] for make in makers]


class _Adapted:
    """Makes what a callable makes, and adapts it."""

    def __init__(
        self, make_env: Callable[[], Any], mode: AutoresetMode, max_episode_steps: int | None
    ) -> None:
        functools.update_wrapper(self, make_env)
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
        own = vector.metadata.get("autoreset_mode")
        if own != self._mode:
            raise ValueError(
                f"{type(vector).__name__} has autoreset_mode {own}, not {self._mode}; make it with "
                "the mode that is asked for, or ask for its own"
            )
        return SubEnvs(vector)


# Gymnasium 1.2 doesn't take parameters here.
if TYPE_CHECKING:
    _Wrapper = gym.vector.VectorWrapper[Any, Any, Any, Any, Any]
else:
    _Wrapper = gym.vector.VectorWrapper


class SubEnvs(_Wrapper):
    """Some vector environment, of Gymnasium's, of a task's or of this package."""

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        # A step takes no turn through here.
        self.step = env.step  # pyright: ignore[reportIncompatibleMethodOverride]
        self._inner: Any = env.unwrapped

    @property
    def takes_masks(self) -> bool:
        """Whether it can reset some of its sub-environments alone."""
        one_by_one = isinstance(self._inner, SyncVectorEnv | AsyncVectorEnv)
        return one_by_one or getattr(self._inner, "takes_masks", False)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As the vector environment does; the seeds may be among the options."""
        if options is not None and SEEDS in options:
            options = dict(options)
            seed = options.pop(SEEDS)
        return self.env.reset(seed=seed, options=options or None)

    def get_wrapper_attr(self, name: str) -> Any:
        """What it tells of the whole."""
        return getattr(self, name)

    def call_sub_envs(
        self, name: str, args: Sequence[Any], kwargs: dict[str, Any], which: Sequence[int] | None
    ) -> list[Any]:
        """Values of a method, or an attribute, of the sub-environments; of those in `which`.

        Raises:
            ValueError: the vector environment can call that of all of them only.
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

    def set_sub_envs(self, name: str, values: Sequence[Any]) -> None:
        """Set an attribute, with one value for each sub-environment."""
        self._able_to("set_attr")(name, list(values))

    def sub_envs_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Whether `wrapper_class` is among the wrappers of each sub-environment."""
        envs: list[Any] = getattr(self._inner, "envs", [])  # A `SyncVectorEnv`'s.
        if any(isinstance(w, wrapper_class) for env in envs for w in wrappers_of(env)):
            return True
        tells = getattr(self._inner, "is_wrapped", None)
        return False if tells is None else tells(wrapper_class)

    def _able_to(self, method: str) -> Any:
        found = getattr(self._inner, method, None)
        if found is None:
            raise AttributeError(
                f"{type(self._inner).__name__} steps its sub-environments together, and has no "
                f"{method}() for each; make separate envs (vectorization_mode='async')"
            )
        return found
