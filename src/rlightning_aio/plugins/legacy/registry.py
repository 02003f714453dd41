"""RLightning's registry of the envs that configs name, its flags, and values of its Ray."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T", bound="Callable[..., Any]")

_FLAGS = ("DEBUG", "VERBOSE", "REMOTE_TRAIN", "REMOTE_EVAL", "REMOTE_STORAGE", "REMOTE_ENV")


class Registry:
    """Classes by name.

    Attributes:
        name: the name of the registry.
        module_dict: the classes by name; assigning to it registers a class.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.module_dict: dict[str, Any] = {}
        self._provided: dict[str, Any] = {}

    def get(self, key: str) -> Any:
        """Return the class registered as `key`.

        Raises:
            KeyError: there is none.
        """
        if key not in self.module_dict:
            raise KeyError(f"{key} is not in the {self.name} registry")
        return self.module_dict[key]

    def provide(self, name: str, value: Any) -> None:
        """Use `value` for `name` until a program registers a class of that name."""
        self.module_dict[name] = self._provided[name] = value

    def register(self, name: str | None = None) -> Callable[[T], T]:
        """Return a class decorator that registers the class as `name`, or by its own name.

        Raises:
            KeyError: a program has registered a class of that name already.
        """

        def remember(kind: T) -> T:
            key: str = kind.__name__ if name is None else name
            if self.module_dict.get(key) is not self._provided.get(key):
                raise KeyError(f"{key} is already registered in the {self.name} registry")
            self.module_dict[key] = kind
            return kind

        return remember


ENVS = Registry("environments")


def load_modules_from_config(config: Any) -> None:
    """Import the modules in a config's ``imports``, which register their classes."""
    for module in config.get("imports", None) or ():
        importlib.import_module(module)


class _Flags(type):
    """Attributes that are read from ``RLIGHTNING_<name>`` (1 or 0) at each access."""

    def __getattr__(cls, name: str) -> bool:
        if name not in _FLAGS:
            raise AttributeError(f"RLightning has no flag {name!r}; it has {', '.join(_FLAGS)}")
        return os.environ.get(f"RLIGHTNING_{name}") == "1"


class InternalFlag(metaclass=_Flags):
    """RLightning's flags: ``InternalFlag.DEBUG`` and so on.

    None has an effect: envs always live in worker processes, and results are values.
    """


def resolve_object(obj: Any) -> Any:
    """Return `obj`: results are values here, never references of Ray."""
    return obj
