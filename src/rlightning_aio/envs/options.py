"""Validate `env_kwargs` of backends that declare them as a pydantic model.

Rule: one message names the env and every wrong field.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from rlightning_aio.config.problems import Problems, explained
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

Options = TypeVar("Options", bound=BaseModel)


def read_options(model: type[Options], owner: str, env_kwargs: Mapping[str, Any]) -> Options:
    """Parse `env_kwargs` as `model`; `owner`, of whom they are, is named in messages.

    Raises:
        ConfigError: fields are unknown, missing or of the wrong type or value; all are named.
    """
    try:
        return model.model_validate(env_kwargs)
    except ValidationError as error:
        problems, faults = Problems(owner), error.errors(include_url=False)
    for path, text in explained(faults, env_kwargs, model.model_fields):
        problems.add(f"env_kwargs.{path}".rstrip("."), text)
    raise problems.error()


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
