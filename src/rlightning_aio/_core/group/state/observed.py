"""`Observed`: reports events of the general path to an observer while one is attached."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, TypeAlias

from rlightning_aio._core.group.state.conditions import RECORDING, Conditions

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["NO_SPAN", "Fate", "Observed", "Observer"]

NO_SPAN: Final = contextlib.nullcontext()
"""The span of an operation while no observer is attached."""
Fate: TypeAlias = Literal["hung", "died", "given up", "up"]
"""What may happen to a host after its first start."""


class Observer(Protocol):
    """Receives the events of a group. Times are monotonic seconds."""

    def call(self, name: str, began: float) -> contextlib.AbstractContextManager[Any]:
        """A context manager around an operation of the core that was called at `began`."""
        ...

    def before_results(self, slots: NDArray[np.intp]) -> Any:
        """Record that results of `slots` are about to be returned, for `after_results`."""
        ...

    def after_results(self, noted: Any, parts: Sequence[ResultColumns]) -> None:
        """Record that results were returned as `parts`; `noted` is from `before_results`."""
        ...

    def note_fate(self, fate: Fate, host_id: int, slot: int, cause: str) -> None:
        """Record what happened to a host; `slot` is the env concerned, or -1."""
        ...


class Observed:
    """Holds the observer of a group.

    Attributes:
        observer: None while no observer is attached.
    """

    def __init__(self, conditions: Conditions) -> None:
        self._conditions = conditions
        self.observer: Observer | None = None

    def attach(self, observer: Observer | None) -> None:
        """Report events to `observer` from now on; None detaches the current one."""
        self.observer = observer
        self._conditions.note(RECORDING, observer is not None)

    def call(self, name: str, began: float) -> contextlib.AbstractContextManager[Any]:
        """Report an operation of the core; the span does nothing without an observer."""
        return NO_SPAN if self.observer is None else self.observer.call(name, began)
