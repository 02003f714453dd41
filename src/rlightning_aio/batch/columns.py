"""`ResultColumns`: the arrays of a batch of results, and `EnvNames`, of the envs of a group."""

from __future__ import annotations

import dataclasses
import pickle
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from rlightning_aio.errors import unreadable
from rlightning_aio.protocol.info import NO_INFO, PICKLED, InfoSchema
from rlightning_aio.protocol.slab import IS_RESET, OVER, TERMINATED, TRUNCATED
from rlightning_aio.trees import Tree, index, mapped

if TYPE_CHECKING:
    from collections.abc import Iterable

# Offset of the monotonic clock, which stamps results, from the epoch.
_EPOCH_NS = time.time_ns() - time.monotonic_ns()


@dataclasses.dataclass(frozen=True, slots=True)
class EnvNames:
    """Ids and config entries of the envs of a group, by slot; they never change.

    Attributes:
        env_ids: id of each env.
        entries: number of the config entry of each slot; entry_names: names of the entries.
        index_offset: position in the group of the first sub-environment of each slot.
    """

    env_ids: Sequence[str]
    entries: NDArray[np.intp]
    entry_names: Sequence[str]
    index_offset: NDArray[np.int64]

    def ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots`, in order."""
        chosen: list[int] = slots.tolist()
        return [self.env_ids[slot] for slot in chosen]

    def names(self, slots: NDArray[np.intp]) -> list[str]:
        """Config entries of `slots`, in order."""
        chosen: list[int] = self.entries[slots].tolist()
        return [self.entry_names[entry] for entry in chosen]

    def of(self, slots: NDArray[np.intp]) -> EnvNames:
        """Select `slots`, which become slots 0, 1, 2, …"""
        return dataclasses.replace(
            self,
            env_ids=self.ids(slots),
            entries=self.entries[slots],
            index_offset=self.index_offset[slots],
        )


class ResultColumns(msgspec.Struct):
    """Results of envs with the same row layout; the first axis of each array is that of rows.

    Attributes:
        slots: slot of the env of each row, in `names`.
        positions: position of each row in the batch; None for 0, 1, 2, …
        observation: tree of arrays, or None if observations are in `out_of_band`.
        reward: ``[n, *head]``; flags: ``[n, *head, 4]``, see `protocol.slab`.
        info_marks, info: see `protocol.info`; None if no row has an info.
        schemas: for each slot, the schemas of its worker by number.
        out_of_band: values that did not fit a row, by row, pickled or plain.
        episode_return, episode_length: of episodes that have ended or were cut; None without any.
        limit_reached: ``[n]``, True if the step limit has cut the episode; None if it is nowhere.
        restarted: ``[n]``, True if the previous episode was lost with its worker; likewise.
        times: ``[n, 2]``: when each result was ready (monotonic), and how long the env took, in ns.
        sent_ns: ``[n]``, see `protocol.slab`; None if the envs use the trainer's clock.
        agents: names of the agents of a multi-agent env.
        observation_space: of one env; None if unknown.
    """

    slots: NDArray[np.intp]
    names: EnvNames
    positions: NDArray[np.intp] | None
    observation: Tree | None
    reward: NDArray[np.float64]
    flags: NDArray[np.bool_]
    info_marks: NDArray[np.uint8] | None
    info: NDArray[np.uint8] | None
    schemas: Sequence[Mapping[int, InfoSchema]]
    out_of_band: dict[int, Any]
    times: NDArray[np.int64]
    episode_return: NDArray[np.float64] | None = None
    episode_length: NDArray[np.int64] | None = None
    limit_reached: NDArray[np.bool_] | None = None
    restarted: NDArray[np.bool_] | None = None
    sent_ns: NDArray[np.int64] | None = None
    agents: tuple[str, ...] = ()
    observation_space: gym.Space[Any] | None = None

    def __len__(self) -> int:
        return len(self.slots)

    def apart(self) -> ResultColumns:
        """Return the same results without a group: their slots are 0, 1, 2, …"""
        slots: list[int] = self.slots.tolist()
        return replace(
            self,
            slots=np.arange(len(slots)),
            names=self.names.of(self.slots),
            schemas=[self.schemas[slot] for slot in slots],
        )

    # -- flags and times of rows ------------------------------------------------------

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """``[n, *head]``."""
        return self.flags[..., TERMINATED]

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """``[n, *head]``."""
        return self.flags[..., TRUNCATED]

    @property
    def done(self) -> NDArray[np.bool_]:
        """``[n, *head]``, terminated or truncated."""
        return self.terminated | self.truncated

    @property
    def is_reset(self) -> NDArray[np.bool_]:
        """``[n]`` or ``[n, num_envs]``, True if no transition ends in the row."""
        resets = self.flags[..., IS_RESET]
        return resets[:, 0] if self.agents else resets

    @property
    def over(self) -> NDArray[np.bool_]:
        """``[n]``, True if all episodes of an env have ended and none was reset since."""
        over = self.flags[..., OVER]
        return over if over.ndim == 1 else np.logical_and.reduce(over.reshape(len(over), -1), 1)

    @property
    def has_ended(self) -> NDArray[np.bool_]:
        """Mask of episodes that have ended for all agents, and were not reset since."""
        over = self.flags[..., OVER]
        return np.logical_and.reduce(over, 1) if self.agents else over

    def by_env(self, column: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        """Return a column of envs, ``[n]``; None is all False."""
        return np.zeros(len(self), np.bool_) if column is None else column

    def by_sub_env(self, column: NDArray[Any] | None) -> NDArray[Any]:
        """Broadcast a column of envs, ``[n]``, to the shape of `is_reset`; None is all False."""
        shape = self.is_reset.shape
        if column is None:
            return np.zeros(shape, np.bool_)
        spread = np.empty(shape, column.dtype)
        spread[...] = column.reshape(len(self), *[1] * (len(shape) - 1))
        return spread

    @property
    def index(self) -> NDArray[np.int64]:
        """``[n]`` or ``[n, num_envs]``, position in the group, counting sub-environments."""
        shape = self.is_reset.shape
        first: NDArray[np.int64] = self.names.index_offset[self.slots]
        if len(shape) == 1:
            return first
        num_envs: int = shape[1]
        return np.add.outer(first, np.arange(num_envs))

    @property
    def ready_ns(self) -> NDArray[np.int64]:
        """``[n]``, time on the monotonic clock when each result was ready."""
        return self.times[:, 0]

    @property
    def busy_ns(self) -> NDArray[np.int64]:
        """``[n]``, time that each env took."""
        return self.times[:, 1]

    # -- one row ----------------------------------------------------------------------

    def out_of_band_of(self, row: int) -> dict[str, Any]:
        """Out-of-band values of `row`.

        Raises:
            EnvRaised: they can't be unpickled in this process.
        """
        found = self.out_of_band.get(row)
        if isinstance(found, bytes):
            try:
                found = pickle.loads(found)
            except Exception as error:
                raise unreadable(error, self.names.env_ids[self.slots.item(row)]) from error
            self.out_of_band[row] = found
        return found or {}

    def observation_of(self, row: int) -> Any:
        """Observation of one env."""
        if self.observation is not None:
            return index(self.observation, row)
        return self.out_of_band_of(row)["observation"]

    def info_of(self, row: int) -> dict[str, Any]:
        """Info of one env, with the sums of its episode if that has just ended."""
        info = self.reported_info_of(row)
        episode = self.episode(row)
        return {"episode": episode, **info} if episode else info

    def reported_info_of(self, row: int) -> dict[str, Any]:
        """Info of one env, as the env reported it."""
        kept = self.out_of_band_of(row) if self.out_of_band else {}
        return kept["info"] if "info" in kept else self._info_in_row(row)

    def may_hold(self, row: int, keys: Iterable[str]) -> bool:
        """Return False if the info of `row` has none of `keys`, as seen without decoding it."""
        mark = self._mark(row)
        if mark in (NO_INFO, PICKLED):
            return row in self.out_of_band
        return not set(keys).isdisjoint(self.schemas[int(self.slots[row])][mark].keys)

    def _mark(self, row: int) -> int:
        return NO_INFO if self.info_marks is None else int(self.info_marks[row])

    def _info_in_row(self, row: int) -> dict[str, Any]:
        mark = self._mark(row)
        if self.info is None or mark in (NO_INFO, PICKLED):
            return {}
        return self.schemas[int(self.slots[row])][mark].decode(memoryview(self.info[row]))

    def episode(self, row: int) -> dict[str, Any]:
        """Sums of the episode that has just ended; empty if none has."""
        if self.episode_return is None or self.episode_length is None:
            return {}
        if self.restarted is not None and self.restarted[row]:
            return {}  # The env has lost the episode, or continues it.
        flags = self.flags[row]
        ended = flags[..., TERMINATED] | flags[..., TRUNCATED]
        lengths = self.episode_length[row] * ended
        if not lengths.any():
            return {}
        returns = self.episode_return[row]
        if ended.ndim == 0:
            return {"r": float(returns), "l": int(lengths)}
        return {"r": returns, "l": lengths, "ended": ended}

    def episode_of_all(self, row: int) -> dict[str, Any]:
        """`episode`, with the returns of agents added, and the length of the longest."""
        sums = self.episode(row)
        if sums and self.agents:
            return {"r": sums["r"].sum(axis=0), "l": sums["l"].max(axis=0)}
        return sums

    def sent_ns_of(self, row: int) -> int:
        """Time when one env sent its result, in ns since the epoch."""
        if self.sent_ns is None:
            return self.times.item(row, 0) + _EPOCH_NS
        return int(self.sent_ns[row])

    def head_of(self, column: NDArray[Any], row: int) -> Any:
        """Reward or flag of one env: a number, an array, or a dict by agent."""
        value = column[row]
        if self.agents:
            return {
                agent: part.item() if part.ndim == 0 else part
                for agent, part in zip(self.agents, value, strict=True)
            }
        return value.item() if value.ndim == 0 else value

    # -- parts ------------------------------------------------------------------------

    def subset(self, rows: Sequence[int], positions: Sequence[int]) -> ResultColumns:
        """Copy some rows, with their positions in another batch."""

        def taken(array: Any) -> Any:
            return None if array is None else array[rows]

        return replace(
            self,
            slots=self.slots[rows],
            positions=np.asarray(positions, np.intp),
            observation=None if self.observation is None else mapped(taken, self.observation),
            out_of_band={
                k: self.out_of_band[row] for k, row in enumerate(rows) if row in self.out_of_band
            },
            **{name: taken(getattr(self, name)) for name in BY_ROW},
        )

    def stacked_head(self, column: str) -> Any:
        """A column of rewards or flags, as a dict by agent if there are agents."""
        array = cast("NDArray[Any]", getattr(self, column))
        if self.agents:
            return {agent: array[:, k] for k, agent in enumerate(self.agents)}
        return array


BY_ROW: Final = (
    "reward",
    "flags",
    "info_marks",
    "info",
    "episode_return",
    "episode_length",
    "limit_reached",
    "restarted",
    "times",
    "sent_ns",
)
"""Attributes of `ResultColumns` that are arrays of rows, or None."""
