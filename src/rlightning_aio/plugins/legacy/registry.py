"""RLightning's registry of the envs that configs name."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "ENVS",
    "Registry",
    "load_modules_from_config",
]

T = TypeVar("T", bound="Callable[..., Any]")


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

    def __repr__(self) -> str:
        return f"Registry(name={self.name}, items={list(self.module_dict)})"

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

    def is_provided(self, name: str) -> bool:
        """Return True if `name` stands for the provided value."""
        return name in self._provided and self.module_dict.get(name) is self._provided[name]

    def register(self, name: str | None = None) -> Callable[[T], T]:
        """Return a class decorator that registers the class as `name`, or by its own name.

        Raises:
            KeyError: a program has registered a class of that name already.
        """

        def remember(kind: T) -> T:
            key: str = kind.__name__ if name is None else name
            if key in self.module_dict and not self.is_provided(key):
                raise KeyError(f"{key} is already registered in the {self.name} registry")
            self.module_dict[key] = kind
            return kind

        return remember


ENVS = Registry("environments")


def load_modules_from_config(config: Any) -> None:
    """Import the modules in a config's ``imports``, which register their classes."""
    for module in config.get("imports", None) or ():
        importlib.import_module(module)
