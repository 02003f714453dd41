"""Functions that execute steps: the short way of plain Gymnasium envs, and steps in two halves.

The short way writes what `RowWriter` would, into memoryviews: assigning an element of one costs a
fifth of assigning an element of an array. All other steps are written by `EnvRunner`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from rlightning_aio.protocol.info import NO_INFO, PICKLED

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.envs.base import BareReset, BareStep
    from rlightning_aio.hosts.messages import OutOfBand
    from rlightning_aio.hosts.row_writer import RowWriter
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

    It remembers what it wrote last, and so writes flags only when they change.

    Args:
        slab, row: where results go.
        writer: of that row.
        resets_itself: the env begins the next episode in the step that ends one.
    """

    def __init__(self, slab: Slab, row: int, writer: RowWriter, *, resets_itself: bool) -> None:
        self._slab, self._row, self._writer = slab, row, writer
        self._resets_itself = resets_itself
        self._return, self._length = 0.0, 0
        # The last result was a reset; it, or one since the last reset, ended the episode.
        self._is_reset = self._is_over = False

    def row_changed(self) -> None:
        """Read what others wrote into the row."""
        slab, row = self._slab, self._row
        self._return, self._length = slab.episode_return.item(row), slab.episode_length.item(row)
        self._is_reset, self._is_over = slab.is_reset.item(row), slab.over.item(row)

    def stepper(
        self, step: BareStep, get_input: GetInput, write_observation: Callable[[Any], None]
    ) -> StepWith:
        """Return a function that steps the env by `step`."""
        slab, row, writer, resets_itself = self._slab, self._row, self._writer, self._resets_itself
        write_info, keep, clock = writer.write_info, writer.keep, time.monotonic_ns
        rewards, marks, resets = view(slab.reward), view(slab.info_mark), view(slab.is_reset)
        returns, lengths = view(slab.episode_return), view(slab.episode_length)
        done_times, busy_times = view(slab.done_ns), view(slab.busy_ns)
        # A plain array that fits is copied here, which saves a call.
        in_row = np.empty(0)
        if type(slab.observation) is np.ndarray:
            in_row = slab.observation[row, ...]
        shape, dtype = in_row.shape, in_row.dtype

        def execute(get_input: GetInput = get_input) -> OutOfBand | None:
            began = clock()
            observation, reward, terminated, truncated, info = step(get_input())
            done = clock()
            done_times[row] = done
            busy_times[row] = done - began
            if (
                type(observation) is np.ndarray
                and observation.dtype is dtype
                and observation.shape == shape
            ):
                in_row[...] = observation
            else:
                write_observation(observation)
            try:
                rewards[row] = reward
            except TypeError:
                rewards[row] = reward = writer.number("reward", reward)
            if self._is_reset:
                resets[row] = self._is_reset = False
            if self._is_over and resets_itself:
                self._return = self._length = 0
            returns[row] = self._return = self._return + reward
            lengths[row] = self._length = self._length + 1
            if self._is_over or terminated or truncated:
                self._write_ends(bool(terminated), bool(truncated))
            marks[row] = mark = write_info(info) if info else NO_INFO
            return keep({"info": info}) if mark == PICKLED else None

        return execute

    def _write_ends(self, terminated: bool, truncated: bool) -> None:
        """Write the flags of a step that ends an episode, or comes after an end."""
        slab, row = self._slab, self._row
        slab.terminated[row], slab.truncated[row] = terminated, truncated
        if self._is_over and not self._resets_itself:
            # A step after the end belongs to no episode; see `EpisodeSums`.
            slab.episode_return[row] = slab.episode_length[row] = 0
        self._is_over = terminated or truncated or not self._resets_itself
        slab.over[row] = self._is_over

    def resetter(self, reset: BareReset, write_observation: Callable[[Any], None]) -> Execute:
        """Return a function that resets the env by `reset`, with the seed in the row."""
        slab, row, writer, clock = self._slab, self._row, self._writer, time.monotonic_ns

        def execute() -> OutOfBand | None:
            began = clock()
            observation, info = reset(seed=slab.take_seed(row), options=None)
            done = clock()
            self._return, self._length, self._is_reset, self._is_over = 0.0, 0, True, False
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
