"""Proxies of the envs of a vector env, as `SyncVectorEnv.envs` has the envs themselves."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["EnvProxy", "check_name"]

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


def check_name(name: str) -> None:
    """Check that `name` may be called on single envs.

    Raises:
        ValueError: it is a method for all envs.
    """
    if name in _NOT_TO_BE_CALLED:
        raise ValueError(f"call {name}() of the vector env itself, not of its envs")
