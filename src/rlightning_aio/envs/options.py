"""Validate `env_kwargs` of backends that declare them as a pydantic model.

Rule: one message names the env and every wrong field.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

Options = TypeVar("Options", bound=BaseModel)


def read_options(model: type[Options], env_id: str, env_kwargs: Mapping[str, Any]) -> Options:
    """Parse `env_kwargs` as `model`.

    Raises:
        ConfigError: a field is unknown, missing or of the wrong type or value.
    """
    try:
        return model.model_validate(env_kwargs)
    except ValidationError as error:
        known = ", ".join(model.model_fields)
        faults = "; ".join(_describe(fault) for fault in error.errors())
        raise ConfigError(f"{env_id}: env_kwargs: {faults}. Known fields: {known}") from None


def load_named(env_id: str, field: str, name: str, separator: str = ":") -> Any:
    """Import the object that ``module:name`` (or ``module::name``) names.

    Raises:
        ConfigError: the module can't be imported, or has no such name.
    """
    module_name, _, attribute = name.partition(separator)
    try:
        return getattr(import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{env_id}: {field}: {name!r} can't be loaded: {error}") from error


def _describe(fault: Any) -> str:
    place = ".".join(map(str, fault["loc"]))
    text = fault["msg"].removeprefix("Value error, ")
    return f"{place}: {text}" if place else text
