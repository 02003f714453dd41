"""Proxies of the envs of a vector env, as `SyncVectorEnv.envs` has the envs themselves."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["CalledEnvs", "EnvProxy", "check_name"]

_NOT_TO_BE_CALLED: Final = ("reset", "step", "close")


class EnvProxy:
    """Fetches an attribute of the env when it is read, and calls its methods.

    Values are copies: changing one does not change the env.

    Args:
        look_up: returns True and None for a method's name, or False and the attribute's value.
        call: calls a method of the env by name.
    """

    def __init__(
        self, look_up: Callable[[str], tuple[bool, Any]], call: Callable[..., Any]
    ) -> None:
        vars(self).update(_look_up=look_up, _call=call)

    @property
    def unwrapped(self) -> EnvProxy:
        """The proxy itself: attributes are found through wrappers."""
        return self

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_look_up" not in vars(self):  # `copy` looks these up.
            raise AttributeError(name)
        is_method, value = self._look_up(name)
        return partial(self._call, name) if is_method else value

    def __setattr__(self, name: str, value: Any) -> None:
        self._call("set_wrapper_attr", name, value)


class CalledEnvs:
    """Mixin for vector envs that answer calls on single envs."""

    num_envs: int

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of each env, found through its wrappers, or get an attribute."""
        raise NotImplementedError

    def _call_one(self, place: int, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env at `place`, or get its attribute."""
        raise NotImplementedError

    def _look_up(self, place: int, name: str) -> tuple[bool, Any]:
        """Return True and None for a method of the env at `place`, or False and the attribute."""
        raise NotImplementedError

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Attribute `name` of each env, found through its wrappers."""
        return self.call(name)

    @property
    def envs(self) -> list[Any]:
        """A proxy of each env; it fetches attributes when they are read."""
        return [
            EnvProxy(partial(self._look_up, place), partial(self._call_one, place))
            for place in range(self.num_envs)
        ]

    @property
    def np_random(self) -> Any:
        """Random generators of the envs: a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """Seeds of the envs' random generators: a tuple."""
        return self.get_attr("np_random_seed")


def check_name(name: str) -> None:
    """Check that `name` may be called on single envs.

    Raises:
        ValueError: it is a method for all envs.
    """
    if name in _NOT_TO_BE_CALLED:
        raise ValueError(f"call {name}() of the vector env itself, not of its envs")
