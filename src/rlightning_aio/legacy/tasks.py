"""What RLightning's programs use of its layer over Ray, where nothing is Ray's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["GlobalResourceManager", "RayActorMixin", "TaskSubmitter", "resolve_object"]


class TaskSubmitter:
    """Calls methods, of envs in workers and of plain objects alike."""

    def __init__(self, max_pending_tasks_each_worker: int = 1) -> None:
        if max_pending_tasks_each_worker < 0:
            raise ValueError("max_pending_tasks_each_worker is a number from 0 up")
        self.max_pending_tasks = max_pending_tasks_each_worker

    def submit(
        self, method: Callable[..., Any], *args: Any, _block: bool = False, **kwargs: Any
    ) -> Any:
        """What `method` returns; there is nothing to wait for any more, whatever `_block` says."""
        del _block
        return method(*args, **kwargs)


def resolve_object(obj: Any) -> Any:
    """`obj` itself: no value here is a reference to one elsewhere."""
    return obj


class RayActorMixin:
    """For classes that Ray may run elsewhere; without it they run here."""


class GlobalResourceManager:
    """Where RLightning keeps who runs on which node; here is one node."""

    @classmethod
    def reset(cls) -> None:
        """There is nothing to forget."""
