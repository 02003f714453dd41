"""Functions that execute steps in two halves."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.hosts.messages import OutOfBand

__all__ = ["Execute", "GetInput", "step_in_halves"]

Execute: TypeAlias = "Callable[[], OutOfBand | None]"
"""Executes a step or a reset; returns the part of the result that is out of band."""
GetInput: TypeAlias = "Callable[[], Any]"
"""Returns the input of one step."""


def step_in_halves(
    start: Callable[[Any], None],
    wait: Callable[[], Any],
    get_input: GetInput,
    store: Callable[[Any, int], OutOfBand | None],
) -> Callable[[], Execute]:
    """Return a function that starts a step and returns the function that ends it.

    Both halves count as the step's time, but not the time between them.
    """
    clock = time.monotonic_ns

    def begin() -> Execute:
        began = clock()
        start(get_input())
        spent = clock() - began

        def end() -> OutOfBand | None:
            began = clock()
            result = wait()
            return store(result, spent + clock() - began)

        return end

    return begin
