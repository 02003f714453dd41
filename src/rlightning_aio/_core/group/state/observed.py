"""`Observed`: reports events of a group to an observer while one is attached."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["NO_SPAN", "Fate", "Observed", "Observer"]

NO_SPAN: Final = contextlib.nullcontext()
"""The span of other work while no observer is attached."""
Fate: TypeAlias = Literal["hung", "raised", "died", "given up", "up"]
"""What may happen to a host after its first start."""


class Observer(Protocol):
    """Receives the events of a group. Times are monotonic seconds."""

    def note_call(self, name: str, began: float) -> None:
        """Record that an operation of the core has ended that was called at `began`."""
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

    def __init__(self) -> None:
        self.observer: Observer | None = None

    def attach(self, observer: Observer | None) -> None:
        """Report events to `observer` from now on; None detaches the current one."""
        self.observer = observer

    def note_fate(self, fate: Fate, host_id: int, slot: int, cause: str) -> None:
        """Report what happened to a host; see `Observer.note_fate`."""
        if self.observer is not None:
            self.observer.note_fate(fate, host_id, slot, cause)

    @contextlib.contextmanager
    def call(self, name: str, began: float) -> Generator[None]:
        """Report an operation of the core that was called at `began`, when the context ends."""
        try:
            yield
        finally:
            if self.observer is not None:
                self.observer.note_call(name, began)
