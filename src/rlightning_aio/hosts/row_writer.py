"""`RowWriter`: how a result becomes a row, in a worker, an inline host and an env_server.

Rule: a row says what it is. Beside observation, reward and ends it tells whether it is a
reset, whether the episode is over, and the episode's return and length so far. What has no
place in the row (a nested info, an observation without a fixed size) is returned, to be
sent out of band; None means that the row holds all of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.hosts.copied import copied
from rlightning_aio.hosts.episodes import EpisodeSums
from rlightning_aio.protocol.columns import fitted_tree, row_writer
from rlightning_aio.protocol.info import PICKLED, InfoSchema, InfoWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rlightning_aio.hosts.messages import OutOfBand
    from rlightning_aio.protocol.slab import Slab
    from rlightning_aio.types import Autoreset

__all__ = ["RowWriter", "infos_out_of_band"]


def infos_out_of_band(schema: InfoSchema) -> int:
    """In place of `announce`: no info is packed into the row."""
    del schema
    return PICKLED


class RowWriter:
    """Writes the results of one env.

    Args:
        slab, row: where.
        env_id: named in errors.
        autoreset: what sub-environments do after an end; see `EnvMeta`.
        announce: tells the trainer of a new way in which infos lie in the row.
        turns: if results come from some of the sub-environments at a time, how many there
            are in all; 0 otherwise.
        copies: what is returned stays in this process, and must be nobody else's.

    Attributes:
        write_observation: into the row; None where observations don't travel there.
        write_info: into the row; returns its mark (see `protocol.info`).
        read_info: what it wrote last, given that mark.
        out_of_band: what was last returned as such.
        shows_some: results come from some of the sub-environments at a time.
    """

    def __init__(
        self,
        slab: Slab,
        row: int,
        *,
        env_id: str,
        autoreset: Autoreset,
        announce: Callable[[InfoSchema], int],
        turns: int = 0,
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
        # With an ellipsis an entry of a plain column is a view, too.
        self._reward, self._flags = slab.reward[row, ...], slab.flags[row, ...]
        self._terminated, self._truncated = slab.terminated[row, ...], slab.truncated[row, ...]
        self._is_reset = slab.is_reset[row, ...]
        self._turns = turns
        self.shows_some = turns > 0
        self._sums = _sums(slab, row, autoreset, turns)

    def begin_episode(self, info: Mapping[str, Any]) -> None:
        """Say that the row is a reset: no reward, no end, nothing summed up."""
        self._reward[...] = 0.0
        self._flags[...] = False
        self._is_reset[...] = True
        if self._turns:
            # The others' first observations are still to come, as results of steps.
            self._sums.begin(begun=np.asarray(info["env_id"]))
            self._show_sums(np.asarray(info["env_id"]))
        else:
            self._sums.begin()

    def look(self) -> None:
        """Take note of what was written to the row past this."""
        self._sums.look()

    def write_ends(
        self, reward: Any, terminated: Any, truncated: Any, info: Mapping[str, Any]
    ) -> None:
        """Write reward and ends of a step, which fit the row, and add it to its episodes."""
        self._reward[...] = reward
        self._terminated[...] = terminated
        self._truncated[...] = truncated
        ended = None
        if terminated is not False or truncated is not False:
            ended = self._terminated | self._truncated
            ended = ended if ended.any() else None
        if self._turns:
            which = np.asarray(info["env_id"])
            reset = self._sums.step(self._reward, ended, which)
            self._show_sums(which)
        else:
            reset = self._sums.step(self._reward, ended)
        self._is_reset[...] = False if reset is None else self._of_all_agents(reset)

    def _of_all_agents(self, reset: Any) -> Any:
        """A sub-environment resets itself for all of its agents."""
        return reset.all(axis=0) if self._slab.layout.agents else reset

    def _show_sums(self, which: Any) -> None:
        slab, row, sums = self._slab, self._row, self._sums
        slab.episode_return[row] = sums.returns[which]
        slab.episode_length[row] = sums.lengths[which]
        slab.over[row] = sums.over[which]

    def checked_ends(self, reward: Any, terminated: Any, truncated: Any) -> tuple[Any, Any, Any]:
        """Reward and ends in the shape of the row, from whatever holds them (tensors, dicts by
        agent, an axis of one too many).

        Those that a result leaves out (0.0 and False, no agent at all) hold for all.

        Raises:
            ValueError: a shape that doesn't fit.
        """
        return (
            self._checked("reward", reward),
            self._checked("terminated", terminated),
            self._checked("truncated", truncated),
        )

    def _checked(self, what: str, value: Any) -> Any:
        layout = self._slab.layout
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
        """The one number that `value` holds, an array of shape (1,) say.

        Raises:
            ValueError: it holds none, or several.
        """
        try:
            return float(self._checked(what, value))
        except TypeError:
            raise ValueError(
                f"{what} of env {self._env_id!r} must be a number, not {value!r}"
            ) from None

    def write_times(self, done_ns: int, busy_ns: int) -> None:
        """Write when the result was ready (monotonic), and what it took the env, in ns."""
        self._slab.times[self._row] = done_ns, busy_ns

    def write_data(
        self, observation: Any, info: dict[str, Any], extra: dict[str, Any] | None = None
    ) -> OutOfBand | None:
        """Write an observation and an info; what of them is out of band."""
        if self._slab.layout.observations_out_of_band:
            return self.kept(self.handed_over(observation, info))
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
        return self.kept(out_of_band) if out_of_band else None

    def handed_over(self, observation: Any, info: dict[str, Any]) -> OutOfBand:
        """What the row would only copy."""
        space = self._slab.layout.observation_space
        observation = fitted_tree(space, observation, "observation")
        self.out_of_band = {"observation": observation, "info": info}
        return self.out_of_band

    def kept(self, out_of_band: OutOfBand) -> OutOfBand:
        """`out_of_band` as the trainer may keep it; pickling copies what leaves the process."""
        self.out_of_band = copied(out_of_band) if self._copies else out_of_band
        return self.out_of_band


def _sums(slab: Slab, row: int, autoreset: Autoreset, turns: int) -> EpisodeSums:
    if turns:
        return EpisodeSums(
            np.zeros(turns), np.zeros(turns, np.int64), np.zeros(turns, np.bool_), autoreset
        )
    return EpisodeSums(
        slab.episode_return[row, ...],
        slab.episode_length[row, ...],
        slab.over[row, ...],
        autoreset,
    )
