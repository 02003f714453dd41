"""Functions that execute steps: the short way of plain Gymnasium envs, and steps in two halves.

The short way writes what `RowWriter` would, by `kernel.row_step`. All other steps are written by
`EnvRunner`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, cast

import numpy as np

from rlightning_aio.envs.tensors import holds_tensor
from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.exchange import Row
from rlightning_aio.protocol.info import NO_INFO, PICKLED

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import OutOfBand
    from rlightning_aio._core.hosts.running.row_writer import RowWriter
    from rlightning_aio.envs.base import BareReset, BareStep
    from rlightning_aio.protocol.slab import Slab

__all__ = ["Execute", "GetInput", "ShortWay", "StepWith", "followed", "step_in_halves", "view"]

Execute: TypeAlias = "Callable[[], OutOfBand | None]"
"""Executes a step or a reset; returns the part of the result that is out of band."""
GetInput: TypeAlias = "Callable[[], Any]"
"""Returns the input of one step."""


class StepWith(Protocol):
    """Steps with the result of `get_input`; by default with the action in the row."""

    def __call__(self, get_input: GetInput = ...) -> OutOfBand | None: ...


class ShortWay:
    """Steps and resets of an env of one agent and one sub-environment.

    Args:
        slab, row: where results go.
        writer: of that row.
        resets_itself: the env begins the next episode in the step that ends one.
    """

    def __init__(self, slab: Slab, row: int, writer: RowWriter, *, resets_itself: bool) -> None:
        self._slab, self._row, self._writer = slab, row, writer
        self._resets_itself = resets_itself

    def stepper(
        self, step: BareStep, get_input: GetInput, write_observation: Callable[[Any], None]
    ) -> StepWith:
        """Return a function that steps the env by `step`."""
        slab, writer, one = self._slab, self._writer, slice(self._row, self._row + 1)
        plain = type(slab.observation) is np.ndarray
        row = Row(
            reward=view(slab.reward[one]),
            flags=view(slab.flags[self._row]),
            episode_return=view(slab.episode_return[one]),
            episode_length=view(slab.episode_length[one]),
            info_mark=view(slab.info_mark[one]),
            times=view(slab.times[self._row]),
            observation=cast("Any", slab.observation)[self._row, ...] if plain else None,
        )
        return kernel.row_step(
            row,
            step,
            get_input,
            write_observation,
            writer.number,
            writer.write_info,
            writer.keep,
            self._resets_itself,
        )

    def resetter(
        self,
        reset: BareReset,
        take_seed: Callable[[], int | None],
        write_observation: Callable[[Any], None],
        store: Callable[[Any, dict[str, Any], int], OutOfBand | None],
    ) -> Execute:
        """Return a function that resets the env by `reset`, with the seed that `take_seed` returns.

        Tensors, with the info and the ns that the env took, are given to `store`.
        """
        slab, row, writer, clock = self._slab, self._row, self._writer, time.monotonic_ns

        def execute() -> OutOfBand | None:
            seed, began = take_seed(), clock()
            observation, info = reset(seed=seed, options=None)
            done = clock()
            if type(observation) is not np.ndarray and holds_tensor(observation):
                return store(observation, info, done - began)
            slab.flags[row] = False
            slab.is_reset[row] = True
            slab.reward[row] = slab.episode_return[row] = 0.0
            slab.episode_length[row] = 0
            writer.write_times(done, done - began)
            write_observation(observation)
            mark = slab.info_mark[row] = writer.write_info(info) if info else NO_INFO
            return writer.keep({"info": info}) if mark == PICKLED else None

        return execute


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


def followed(execute: Execute, then: Callable[[], None]) -> Execute:
    """Return a function that calls `execute`, then `then`."""

    def execute_both() -> OutOfBand | None:
        outcome = execute()
        then()
        return outcome

    return execute_both


def view(array: NDArray[Any]) -> memoryview[Any]:
    """Return a memoryview of an array."""
    # NumPy's types know that arrays are buffers from Python 3.12 on.
    return memoryview(array)  # pyright: ignore[reportArgumentType]
