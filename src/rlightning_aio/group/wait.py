"""`Wait` and `Procedure`: how the core says that it can't go on yet."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Final, TypeAlias, TypeVar

__all__ = ["TURN", "Procedure", "Wait", "earliest"]

T = TypeVar("T")


@dataclass(slots=True)
class Wait:
    """Block until a source tells something, or until `until` (monotonic seconds).

    A time that has passed means: look at all sources once, without blocking.
    """

    until: float | None = None


TURN: Final = Wait(0.0)
"""Let others who wait have their turn, as what is waited for has come. Where nobody else can
wait, there is nothing to do.
"""

Procedure: TypeAlias = Generator[Wait, float, T]
"""Yields what it waits for, is sent the time, returns its result.

Before it goes on, its driver has the core take in what hosts have told (`Core.drain`).
"""


def earliest(*times: float | None) -> float | None:
    """The first of the times that are known."""
    first = None
    for time in times:
        if time is not None and (first is None or time < first):
            first = time
    return first
