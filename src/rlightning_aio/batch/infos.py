"""Infos as columns, in the form of Gymnasium's vector environments, by its own code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gymnasium.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["vector_infos"]


class _Columns(VectorEnv[Any, Any, Any]):
    """Knows how infos become columns, and nothing else of an environment."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs

    def of(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        columns: dict[str, Any] = {}
        for place, info in enumerate(infos):
            columns = self._add_info(columns, info, place)
        return columns


def vector_infos(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One dict of columns for `infos`: a typed array for each key, and a mask ``_key``."""
    return _Columns(len(infos)).of(infos)
