"""`Wait` and `Procedure`: how the core says that it can't go on yet."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

__all__ = ["Procedure", "Wait", "earliest"]

T = TypeVar("T")


@dataclass(slots=True)
class Wait:
    """Block until a source tells something, or until `until` (monotonic seconds).

    A time that has passed means: look at all sources once, without blocking.
    """

    until: float | None = None


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
