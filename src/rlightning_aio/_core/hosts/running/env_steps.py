"""Functions that execute steps: in two halves, or followed by something else."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio._core.hosts.messages import OutOfBand

__all__ = ["Execute", "GetInput", "followed", "step_in_halves"]

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


def followed(execute: Execute, followers: Sequence[Callable[[], None]]) -> Execute:
    """Return a function that calls `execute`, then each of `followers`."""

    def execute_all() -> OutOfBand | None:
        outcome = execute()
        for then in followers:
            then()
        return outcome

    return execute_all
