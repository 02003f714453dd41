"""`Wait` and `Procedure`: how the core, which never waits, asks its driver to wait; and
`CollectRules`: for which results a collect waits.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias, TypeVar

import msgspec

__all__ = ["ANY", "TURN", "CollectRules", "Procedure", "Wait", "earliest"]

T = TypeVar("T")


@dataclass(slots=True)
class Wait:
    """A request to block until a source is readable, or until `until` (monotonic seconds).

    If `until` has passed, the driver polls all sources once without blocking.
    """

    until: float | None = None


ANY: Final = Wait()
"""Block until a source is readable."""
TURN: Final = Wait(0.0)
"""The result is ready; let other waiting calls run first. Does nothing in a synchronous group,
where no other call can wait.
"""

Procedure: TypeAlias = Generator[Wait, float, T]
"""A generator that yields waits, receives the time after each, and returns its result.

The driver calls `Core.drain` before it resumes a procedure.
"""


class CollectRules(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """The checked arguments of `EnvGroup.collect_async`.

    Each collect makes one, so this is a `Struct`: a frozen dataclass takes four times as long.
    """

    timeout: float | None = None
    wait_all: bool = False
    min_results: int = 1
    max_results: int | None = None
    deadline: float | None = None
    entries: Sequence[str] | None = None
    ordered: bool = False


def earliest(*times: float | None) -> float | None:
    """The earliest of the times that are not None, or None."""
    first = None
    for time in times:
        if time is not None and (first is None or time < first):
            first = time
    return first
