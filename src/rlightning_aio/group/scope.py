"""`Scope`: what holds within a ``with``, be it plain or asynchronous."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

__all__ = ["Scope"]


class Scope(ABC):
    """Neither entering nor leaving it waits for anything, so both kinds of ``with`` will do."""

    @abstractmethod
    def _enter(self) -> None:
        """What entering does."""

    @abstractmethod
    def _leave(self) -> None:
        """What leaving does, also after an error."""

    def __enter__(self) -> Self:
        self._enter()
        return self

    def __exit__(self, *error: object) -> None:
        self._leave()

    async def __aenter__(self) -> Self:
        return self.__enter__()

    async def __aexit__(self, *error: object) -> None:
        self._leave()
