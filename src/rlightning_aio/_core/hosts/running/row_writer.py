"""`RowWriter`: writes results into rows, in a worker, an inline host and an env_server.

A row holds observation, reward and ends, and also whether it is a reset, whether the episode is
over, and the episode's return and length so far. Data without a place in the row (a nested info,
an observation without a fixed size) is returned, to be sent out of band; None means that the row
holds all of the result.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.hosts.running.copied import copied
from rlightning_aio._core.hosts.running.episodes import EpisodeSums
from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.protocol.columns import fitted_tree, row_writer
from rlightning_aio.protocol.info import PICKLED, InfoSchema, InfoWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rlightning_aio._core.hosts.messages import OutOfBand
    from rlightning_aio.protocol.slab import Slab
    from rlightning_aio.types import Autoreset

__all__ = ["RowWriter", "infos_out_of_band"]


def infos_out_of_band(schema: InfoSchema) -> int:
    """Stand in for `announce`, so that no info is packed into the row."""
    del schema
    return PICKLED


class RowWriter:
    """Writes the results of one env.

    Args:
        slab, row: where the results go.
        env_id: named in errors.
        autoreset: when sub-environments reset themselves; see `EnvMeta`.
        announce: sends a new schema of infos to the trainer, and returns its number.
        partial_of: the number of sub-environments, if a result is of some of them only; else 0.
        copies: data out of band stays in this process, so it must be copied.

    Attributes:
        write_observation: writes into the row; None if observations travel out of band.
        write_info: writes into the row and returns the mark (see `protocol.info`).
        read_info: reads the last info from the row, given its mark.
        out_of_band: the last data out of band.
        partial_results: a result is of some of the sub-environments only.
    """

    def __init__(
        self,
        slab: Slab,
        row: int,
        *,
        env_id: str,
        autoreset: Autoreset,
        announce: Callable[[InfoSchema], int],
        partial_of: int = 0,
        copies: bool = False,
    ) -> None:
        self._slab = slab
        self._row = row
        self._env_id = env_id
        self._copies = copies
        layout = slab.layout
        self.write_observation: Callable[[Any], None] | None = None
        if slab.observation is not None:
            self.write_observation = row_writer(
                layout.observation_space, slab.observation, row, "observation"
            )
        infos = InfoWriter(memoryview(slab.info[row]), announce)
        self.write_info, self.read_info = infos.write, infos.read
        self.out_of_band: OutOfBand = {}
        self._whole: Any = None
        self._whole_since = 0
        # With an ellipsis, an element of a plain column is a view, too.
        self._reward, self._flags = slab.reward[row, ...], slab.flags[row, ...]
        self._terminated, self._truncated = slab.terminated[row, ...], slab.truncated[row, ...]
        self._is_reset = slab.is_reset[row, ...]
        self.partial_results = partial_of > 0
        self._sums = _sums(slab, row, autoreset, partial_of)

    def begin_episode(self, info: Mapping[str, Any]) -> None:
        """Mark the row as a reset: no reward, no end, sums of 0."""
        self._reward[...] = 0.0
        self._flags[...] = False
        self._is_reset[...] = True
        if self.partial_results:
            # The first observations of the others will come as results of steps.
            self._sums.begin(begun=np.asarray(info["env_id"]))
            self._show_sums(np.asarray(info["env_id"]))
        else:
            self._sums.begin()

    def row_changed(self) -> None:
        """Read what others wrote into the row."""
        self._sums.row_changed()

    def write_ends(
        self, reward: Any, terminated: Any, truncated: Any, info: Mapping[str, Any]
    ) -> None:
        """Write reward and ends, and add the step to the sums.

        They may be tensors, dicts by agent, or have an extra axis of length one. Values that a
        result leaves out (0.0 and False, a dict without agents) apply to all.

        Raises:
            ValueError: a shape doesn't fit; nothing was written.
        """
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
        if self.partial_results:
            which = np.asarray(info["env_id"])
            reset = self._sums.step(self._reward, ended, which)
            self._show_sums(which)
        else:
            reset = self._sums.step(self._reward, ended)
        self._is_reset[...] = False if reset is None else self._of_all_agents(reset)

    def _of_all_agents(self, reset: Any) -> Any:
        """Combine the agents: a sub-environment resets itself for all of them."""
        return reset.all(axis=0) if self._slab.layout.agents else reset

    def _show_sums(self, which: Any) -> None:
        slab, row, sums = self._slab, self._row, self._sums
        slab.episode_return[row] = sums.returns[which]
        slab.episode_length[row] = sums.lengths[which]
        slab.over[row] = sums.over[which]

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

    def number(self, what: str, value: Any) -> float:
        """Return the one number in `value`, such as an array of shape (1,).

        Raises:
            ValueError: it holds no number, or several.
        """
        try:
            return float(self._checked(what, value))
        except TypeError:
            raise ValueError(
                f"{what} of env {self._env_id!r} must be a number, not {value!r}"
            ) from None

    def write_times(self, done_ns: int, busy_ns: int) -> None:
        """Write when the result was ready (monotonic) and how long the env took, in ns."""
        self._slab.times[self._row] = done_ns, busy_ns

    def write_data(
        self, observation: Any, info: dict[str, Any], extra: dict[str, Any] | None = None
    ) -> OutOfBand | None:
        """Write an observation and an info, and return the part that is out of band."""
        if self._slab.layout.observations_out_of_band:
            return self.keep(self.hand_over(observation, info))
        out_of_band: OutOfBand = {}
        if self.write_observation is None:
            out_of_band["observation"] = observation
        else:
            self.write_observation(observation)
        mark = self._slab.info_mark[self._row] = self.write_info(info)
        if mark == PICKLED:
            out_of_band["info"] = as_numpy(info)
        if extra:
            out_of_band["extra"] = extra
        return self.keep(out_of_band) if out_of_band else None

    def hand_over(self, observation: Any, info: dict[str, Any]) -> OutOfBand:
        """Return observation and info for the trainer to use without a copy."""
        space = self._slab.layout.observation_space
        observation = fitted_tree(space, observation, "observation")
        self.out_of_band = {"observation": observation, "info": info}
        return self.out_of_band

    def hand_over_whole(self, result: Any) -> OutOfBand:
        """Return a result for the trainer to use without a copy; its times are in the row."""
        self._whole, self._whole_since = result, int(self._slab.done_ns[self._row])
        return {"ret": result}

    @property
    def whole(self) -> Any:
        """The last result if it was handed over whole, otherwise None."""
        # Not every path to the row passes here, but all of them write their times.
        return self._whole if self._slab.done_ns[self._row] == self._whole_since else None

    def keep(self, out_of_band: OutOfBand) -> OutOfBand:
        """Return `out_of_band` for the trainer to keep; pickling copies it for other processes."""
        self.out_of_band = copied(out_of_band) if self._copies else out_of_band
        return self.out_of_band


def _sums(slab: Slab, row: int, autoreset: Autoreset, partial_of: int) -> EpisodeSums:
    if partial_of:
        return EpisodeSums(
            np.zeros(partial_of),
            np.zeros(partial_of, np.int64),
            np.zeros(partial_of, np.bool_),
            autoreset,
        )
    return EpisodeSums(
        slab.episode_return[row, ...],
        slab.episode_length[row, ...],
        slab.over[row, ...],
        autoreset,
    )
