"""Collects what is wrong with a configuration, and raises all of it at once."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from pydantic_core import ErrorDetails


@dataclass(slots=True)
class Problems:
    """The problems found in one source, in its order."""

    source: str
    lines: list[str] = field(default_factory=list[str])

    def add(self, where: str, what: str) -> None:
        """Note a problem; `where` is the entry and field, or empty for the whole source."""
        self.lines.append(f"{where}: {what}" if where else what)

    def raise_any(self) -> None:
        """Raise one `ConfigError` that lists all problems, if there are any."""
        if self.lines:
            raise self.error()

    def error(self) -> ConfigError:
        """Return the error that lists them."""
        if len(self.lines) == 1:
            return ConfigError(f"{self.source}: {self.lines[0]}")
        listed = "".join(f"\n  {line}" for line in self.lines)
        return ConfigError(f"{self.source}: {len(self.lines)} problems{listed}")


def unknown_field(name: object, known: Iterable[str]) -> str:
    """Return the message for a field that does not exist, with the nearest one that does."""
    hint = did_you_mean(str(name), known) or f"known: {', '.join(known)}"
    return f"unknown field; {hint}"


def as_text(value: object) -> str:
    """Return the value as messages show it, shortened."""
    return reprlib.repr(value)


def explained(
    faults: Sequence[ErrorDetails], fields: Mapping[str, Any], known: Iterable[str]
) -> Iterator[tuple[str, str]]:
    """Yield path and text of each fault that pydantic has found in `fields`; `known` are possible.

    Branches of a union share a path, so they share a text.
    """
    texts: dict[str, list[str]] = {}
    inputs: dict[str, str] = {}
    for fault in faults:
        path = _path(fault["loc"], fields)
        text = fault["msg"].removeprefix("Value error, ").removeprefix("Input ")
        text = text.replace("valid tuple", "list")
        if fault["type"] in ("extra_forbidden", "invalid_key") and len(fault["loc"]) == 1:
            text = unknown_field(path, known)
        elif fault["type"] != "value_error":
            inputs[path] = f", got {as_text(fault['input'])}"
        texts.setdefault(path, []).append(text)
    for path, (first, *others) in texts.items():
        alternatives = [first, *(other.removeprefix("should be ") for other in others)]
        yield path, " or ".join(alternatives) + inputs.get(path, "")


def _path(location: Sequence[int | str], fields: Mapping[str, Any]) -> str:
    """Return the dotted path of a fault, without what pydantic adds for unions and keys."""
    value: Any = fields
    parts: list[str] = []
    for part in location:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            break
        parts.append(str(part))
    return ".".join(parts or map(str, location[:1]))
