"""`Scope`: a context manager for both ``with`` and ``async with``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

__all__ = ["Scope"]


class Scope(ABC):
    """A context manager that never waits, so it supports both kinds of ``with``."""

    @abstractmethod
    def _enter(self) -> None:
        """Enter the context."""

    @abstractmethod
    def _leave(self) -> None:
        """Leave the context, also after an error."""

    def __enter__(self) -> Self:
        self._enter()
        return self

    def __exit__(self, *error: object) -> None:
        self._leave()

    async def __aenter__(self) -> Self:
        return self.__enter__()

    async def __aexit__(self, *error: object) -> None:
        self._leave()
