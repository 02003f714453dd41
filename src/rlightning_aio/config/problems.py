"""Collects what is wrong with a configuration, and raises all of it at once."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["Problems", "as_text", "unknown_field"]


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
        if len(self.lines) == 1:
            raise ConfigError(f"{self.source}: {self.lines[0]}")
        if self.lines:
            listed = "".join(f"\n  {line}" for line in self.lines)
            raise ConfigError(f"{self.source}: {len(self.lines)} problems{listed}")


def unknown_field(name: object, known: Iterable[str]) -> str:
    """Return the message for a field that does not exist, with the nearest one that does."""
    hint = did_you_mean(str(name), known) or f"known: {', '.join(known)}"
    return f"unknown field; {hint}"


def as_text(value: object) -> str:
    """Return the value as messages show it, shortened."""
    return reprlib.repr(value)
