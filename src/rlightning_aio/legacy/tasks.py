"""The names of RLightning's layer over Ray, without Ray."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["GlobalResourceManager", "RayActorMixin", "TaskSubmitter", "resolve_object"]


class TaskSubmitter:
    """Calls methods of envs and of any other objects."""

    def __init__(self, max_pending_tasks_each_worker: int = 1) -> None:
        if max_pending_tasks_each_worker < 0:
            raise ValueError("max_pending_tasks_each_worker must be 0 or more")
        self.max_pending_tasks = max_pending_tasks_each_worker

    def submit(
        self, method: Callable[..., Any], *args: Any, _block: bool = False, **kwargs: Any
    ) -> Any:
        """Call `method` and return its value; `_block` has no effect."""
        del _block
        return method(*args, **kwargs)


def resolve_object(obj: Any) -> Any:
    """Return `obj`: values are never references here."""
    return obj


class RayActorMixin:
    """A base class for Ray actors, which does nothing without Ray."""


class GlobalResourceManager:
    """RLightning's table of nodes, which does nothing without Ray."""

    @classmethod
    def reset(cls) -> None:
        """Do nothing."""
