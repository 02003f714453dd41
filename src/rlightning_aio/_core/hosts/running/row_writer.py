"""`RowWriter`: writes results into rows, in a worker, an inline host and an env_server.

A row holds observation, reward and ends, and also whether it is a reset, whether the episode is
over, and the episode's return and length so far. Data without a place in the row (a nested info,
an observation without a fixed size) is returned, to be sent out of band; None means that the row
holds all of the result.
Rule: only `write_step`, `write_reset` and `write_shown` write columns of results, and one function
beside them, `kernel.row_step`, which writes what `write_step` would for a plain Gymnasium env.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.columns import fitted_tree, row_reader, row_writer
from rlightning_aio.protocol.exchange import Row, unpacked
from rlightning_aio.protocol.info import PICKLED, InfoSchema, InfoWriter
from rlightning_aio.trees import as_numpy, copied, holds_tensor

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import OutOfBand
    from rlightning_aio.envs.fast_path import BareResult, BareStep
    from rlightning_aio.protocol.slab import Slab
    from rlightning_aio.types import Autoreset

Execute: TypeAlias = "Callable[[], OutOfBand | None]"
"""Executes a step or a reset; returns the part of the result that is out of band."""
GetInput: TypeAlias = "Callable[[], Any]"
"""Returns the input of one step."""


def infos_out_of_band(schema: InfoSchema) -> int:
    """Stand in for `announce`, so that no info is packed into the row."""
    del schema
    return PICKLED


@dataclass(frozen=True)
class ShownResult:
    """A result taken out of its row.

    Attributes:
        observation, info: of the result.
        returns, lengths, over: of the current episodes, in the shape of the row's columns.
    """

    observation: Any
    info: dict[str, Any]
    returns: NDArray[Any]
    lengths: NDArray[Any]
    over: NDArray[Any]


class EpisodeSums:
    """Return and length of the current episodes of one env, added up in place.

    There is one sum for each agent and sub-environment, over the steps between a reset and an end.
    The sums are in the row, because the trainer ends episodes at a step limit and needs them. A
    step in which a sub-environment resets itself belongs to no episode, and neither do steps
    between an end and the next reset.

    Args:
        returns: float64, lengths: int64, over: bool; all of shape `[*agents, *sub_envs]`.
        autoreset: when sub-environments reset themselves; see `EnvMeta`.

    Attributes:
        returns, lengths: of each episode, including the last step. If that step belongs to no
            episode, the length is 0, and the return is that of the previous episode, or 0 if the
            step was a reset.
        over: True for each that ended and was not reset since.
    """

    def __init__(
        self,
        returns: NDArray[np.float64],
        lengths: NDArray[np.int64],
        over: NDArray[np.bool_],
        autoreset: Autoreset,
    ) -> None:
        self.returns, self.lengths, self.over = returns, lengths, over
        self._autoreset = autoreset

    def begin(self) -> None:
        """Begin new episodes."""
        self.returns[...] = 0.0
        self.lengths[...] = 0
        self.over[...] = False

    def step(
        self, reward: NDArray[np.float64], ended: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_] | None:
        """Count one step of all sub-environments.

        Args:
            reward: of each.
            ended: whether each was terminated or truncated in it; None if none was.

        Returns:
            A mask of those that reset themselves in this step; None if none did.
        """
        if ended is None and not np.count_nonzero(self.over):
            np.add(self.returns, reward, out=self.returns)
            np.add(self.lengths, 1, out=self.lengths)
            return None
        return self._step_around_ends(reward, ended)

    def _step_around_ends(
        self, reward: NDArray[np.float64], ended: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_] | None:
        over = self.over.copy()
        same_step, next_step = self._autoreset == "same_step", self._autoreset == "next_step"
        some = np.count_nonzero(over) > 0
        if same_step and some:
            # These already began their next episode.
            self.returns[over] = self.lengths[over] = 0
        # An agent that waits for others keeps its return, so that they can be added up.
        waits = some and self._autoreset == "disabled"
        self.returns[...] += np.where(over, 0.0, reward) if waits else reward
        self.lengths[...] += 1
        if some and not same_step:
            self.lengths[over] = 0
        if some and next_step:
            self.returns[over] = 0.0
        if ended is None:
            now = np.zeros_like(over) if same_step or next_step else over
        elif same_step:
            now = ended
        else:
            now = ended & ~over if next_step else over | ended
        self.over[...] = now
        return over if next_step and some else None


class RowWriter:
    """Writes the results of one env.

    Args:
        slab, row: where the results go.
        env_id: named in errors.
        autoreset: when sub-environments reset themselves; see `EnvMeta`.
        announce: sends a new schema of infos to the trainer, and returns its number.
        stays_here: data out of band stays in this process: it must be copied, and an observation
            that holds tensors, which become NumPy arrays elsewhere, is handed over as it is.

    Attributes:
        holds_tensor: the last observation does, and stays in this process.
    """

    def __init__(
        self,
        slab: Slab,
        row: int,
        *,
        env_id: str,
        autoreset: Autoreset,
        announce: Callable[[InfoSchema], int],
        stays_here: bool = False,
    ) -> None:
        self._slab = slab
        self._row = row
        self._env_id = env_id
        self._autoreset = autoreset
        self._stays_here = stays_here
        layout = slab.layout
        self._hands_over = layout.observations_out_of_band
        self._write_observation: Callable[[Any], None] | None = None
        if slab.observation is not None:
            self._write_observation = row_writer(slab.observation, row, "observation")
        self._infos = InfoWriter(memoryview(slab.info[row]), announce)
        self._last_out_of_band: OutOfBand = {}
        self.holds_tensor = False
        self._times = _view(slab.times[row])
        # With an ellipsis, an element of a plain column is a view, too.
        self._reward, self._flags = slab.reward[row, ...], slab.flags[row, ...]
        self._terminated, self._truncated = slab.terminated[row, ...], slab.truncated[row, ...]
        self._is_reset = slab.is_reset[row, ...]
        self._sums = EpisodeSums(
            slab.episode_return[row, ...],
            slab.episode_length[row, ...],
            slab.over[row, ...],
            autoreset,
        )

    def write_step(
        self,
        result: BareResult,
        busy_ns: int,
        extra: dict[str, Any] | None = None,
    ) -> OutOfBand | None:
        """Write the result of a step, and return the part that is out of band.

        Args:
            result: observation, reward, both ends and info. Reward and ends may be tensors, dicts
                by agent, or have an extra axis of length one. Values that a result leaves out
                (0.0 and False, a dict without agents) apply to all. An observation that is handed
                over is not copied: `fresh_results` says that the env doesn't use it again.
            busy_ns: how long the env took.
            extra: `_extra` of the result.

        Raises:
            ValueError: a shape doesn't fit.
        """
        self._write_times(busy_ns)
        self._write_ends(*unpacked(result)[1:4])
        return self._write_data(result, extra, is_fresh=self._hands_over)

    def write_reset(
        self, result: BareResult, busy_ns: int, extra: dict[str, Any] | None = None
    ) -> OutOfBand | None:
        """Write the first result of an episode, and return the part that is out of band.

        It has no reward and no end, whatever `result` says, and its sums are 0. All else is as of
        `write_step`.
        """
        self._write_times(busy_ns)
        self._write_no_transition()
        self._sums.begin()
        return self._write_data(result, extra)

    def write_shown(self, shown_result: ShownResult) -> OutOfBand | None:
        """Write what `shown_result` has returned, and return the part that is out of band.

        It is no transition. Observation, info and the sums are as before.
        """
        self._write_times(0)
        self._write_no_transition()
        slab, row = self._slab, self._row
        slab.over[row, ...] = shown_result.over
        slab.episode_return[row, ...] = shown_result.returns
        slab.episode_length[row, ...] = shown_result.lengths
        result = shown_result.observation, 0.0, False, False, shown_result.info
        return self._write_data(result, None)

    def shown_result(self) -> ShownResult:
        """Return a copy of the row and of what was out of band."""
        slab, row = self._slab, self._row
        mark = int(slab.info_mark[row])
        last = self._last_out_of_band
        info = last.get("info", {}) if mark == PICKLED else self._infos.read(mark)
        if slab.observation is None or self.holds_tensor:
            observation = last.get("observation")
        else:
            observation = row_reader(slab.observation, row)()
        sums = (slab.episode_return, slab.episode_length, slab.over)
        return ShownResult(observation, info, *(column[row, ...].copy() for column in sums))

    def short_stepper(self, step: BareStep, get_input: GetInput) -> Execute | None:
        """Return a function that steps the env by `step` and writes the result by itself.

        It is for an env of one agent and one sub-environment. None if this writer is needed.
        """
        slab, row, write_observation = self._slab, self._row, self._write_observation
        resets_itself = self._autoreset == "same_step"
        if slab.layout.head or write_observation is None or self.holds_tensor:
            return None
        if self._autoreset != "disabled" and not resets_itself:
            return None
        one = slice(row, row + 1)
        plain = type(slab.observation) is np.ndarray
        in_row = Row(
            reward=_view(slab.reward[one]),
            flags=_view(slab.flags[row]),
            episode_return=_view(slab.episode_return[one]),
            episode_length=_view(slab.episode_length[one]),
            info_mark=_view(slab.info_mark[one]),
            times=self._times,
            observation=cast("Any", slab.observation)[row, ...] if plain else None,
        )
        return kernel.row_step(
            in_row,
            step,
            get_input,
            write_observation,
            self._number,
            self._infos.write,
            self._kept,
            resets_itself,
        )

    # -- columns ------------------------------------------------------------------

    def _write_times(self, busy_ns: int) -> None:
        """Write that the result is ready now (monotonic), and how long the env took, in ns."""
        self._times[0] = time.monotonic_ns()
        self._times[1] = busy_ns

    def note_begin(self) -> None:
        """Write that a request is executed now: the time of an env is negative until it ends."""
        self._times[1] = -time.monotonic_ns()

    def _write_no_transition(self) -> None:
        self._reward[...] = 0.0
        self._flags[...] = False
        self._is_reset[...] = True

    def _write_ends(self, reward: Any, terminated: Any, truncated: Any) -> None:
        """Write reward and ends, and add the step to the sums."""
        reward = self._checked("reward", reward)
        terminated = self._checked("terminated", terminated)
        truncated = self._checked("truncated", truncated)
        self._reward[...] = reward
        self._terminated[...] = terminated
        self._truncated[...] = truncated
        ended = None
        if terminated is not False or truncated is not False:
            ended = self._terminated | self._truncated
            ended = ended if np.count_nonzero(ended) else None
        reset = self._sums.step(self._reward, ended)
        self._is_reset[...] = False if reset is None else self._of_all_agents(reset)

    def _of_all_agents(self, reset: Any) -> Any:
        """Combine the agents: a sub-environment resets itself for all of them."""
        return reset.all(axis=0) if self._slab.layout.agents else reset

    def _checked(self, what: str, value: Any) -> Any:
        layout = self._slab.layout
        if type(value) is np.ndarray and value.shape == layout.head:
            return value
        if type(value) in (float, bool) and not (value and layout.head):
            return value
        if layout.agents and isinstance(value, dict) and not value:
            return False
        if layout.agents:
            value = [as_numpy(value[agent]) for agent in layout.agents]
        array = np.asarray(as_numpy(value))
        if array.shape != layout.head and array.size == self._reward.size:
            array = array.reshape(layout.head)  # ManiSkill's (1,) for one sub-environment, say.
        if array.shape != layout.head:
            raise ValueError(
                f"{what} of env {self._env_id!r} has shape {array.shape}, expected {layout.head}"
            )
        return array

    def _number(self, what: str, value: Any) -> float:
        """Return the one number in `value`, such as an array of shape (1,).

        Raises:
            ValueError: it holds no number, or several.
        """
        try:
            return float(np.asarray(self._checked(what, value), np.float64))
        except TypeError:
            raise ValueError(
                f"{what} of env {self._env_id!r} must be a number, not {value!r}"
            ) from None

    def _write_data(
        self,
        result: BareResult,
        extra: dict[str, Any] | None,
        *,
        is_fresh: bool = False,
    ) -> OutOfBand | None:
        """Write observation and info, and return the part that is out of band.

        Where `is_fresh`, that is not copied.
        """
        observation, info = result[0], result[4]
        out_of_band: OutOfBand = {}
        self.holds_tensor = False
        if type(observation) is not np.ndarray and holds_tensor(observation):
            self.holds_tensor = self._stays_here
            observation = observation if self._stays_here else as_numpy(observation)
        if self.holds_tensor or self._write_observation is None:
            if self._hands_over and not self.holds_tensor:
                space = self._slab.layout.observation_space
                observation = fitted_tree(space, observation, "observation")
            out_of_band["observation"] = observation
        else:
            self._write_observation(observation)
        mark = self._slab.info_mark[self._row] = self._infos.write(info)
        if mark == PICKLED:
            out_of_band["info"] = info
        if extra:
            out_of_band["extra"] = extra
        return self._kept(out_of_band, is_fresh=is_fresh) if out_of_band else None

    def _kept(self, out_of_band: OutOfBand, *, is_fresh: bool = False) -> OutOfBand:
        """Return `out_of_band` for the trainer to keep; pickling copies it for other processes."""
        if "info" in out_of_band:
            out_of_band["info"] = as_numpy(out_of_band["info"])
        copies = self._stays_here and not is_fresh
        self._last_out_of_band = copied(out_of_band) if copies else out_of_band
        return self._last_out_of_band


def _view(array: NDArray[Any]) -> memoryview[Any]:
    """Return a memoryview of an array."""
    # NumPy's types know that arrays are buffers from Python 3.12 on.
    return memoryview(array)  # pyright: ignore[reportArgumentType]
