"""`ResultColumns`: the arrays that a batch of results consists of."""

from __future__ import annotations

import pickle
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.protocol.columns import Tree, index, mapped
from rlightning_aio.protocol.info import NO_INFO, PICKLED, InfoSchema
from rlightning_aio.protocol.slab import IS_RESET, OVER, TERMINATED, TRUNCATED
from rlightning_aio.types import EnvRet, MultiAgentEnvRet

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.batch.names import EnvNames

__all__ = ["BY_ROW", "ResultColumns"]

# The monotonic clock's distance to the epoch; workers stamp results with the former.
_EPOCH_NS = time.time_ns() - time.monotonic_ns()


@dataclass(slots=True)
class ResultColumns:
    """Results of envs whose rows have one layout; every array has them on its first axis.

    Attributes:
        slots: the env of each row, a slot of `names`.
        positions: the place of each row in the batch; None for 0, 1, 2, …
        observation: tree of arrays, or None where observations came one by one
            (`out_of_band`).
        reward: ``[n, *head]``; flags: ``[n, *head, 4]``, see `protocol.slab`.
        info_marks, info: see `protocol.info`; None where no env has put any into its row.
        schemas: by slot, its worker's schemas by number.
        out_of_band: what did not fit a row, by row, pickled or plain.
        whole_results: some of these are results handed over whole, which are never pickled.
        episode_return, episode_length: of episodes that have ended, or were cut; None if
            nowhere.
        limit_reached: ``[n]``, where the step limit has cut an episode; None if nowhere.
        restarted: ``[n]``, where the episode before was lost with its worker; likewise.
        times: ``[n, 2]``: when each result was ready (monotonic), and the time the env took,
            in ns.
        sent_ns: ``[n]``, see `protocol.slab`; None where the trainer's clock is the env's.
        agents: names of a multi-agent env's agents.
        observation_space: of one env; None if it isn't known.
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
    whole_results: bool = False

    def __len__(self) -> int:
        return len(self.slots)

    def apart(self) -> ResultColumns:
        """The same results without a group around them: slots 0, 1, 2, … are its own rows."""
        slots: list[int] = self.slots.tolist()
        return replace(
            self,
            slots=np.arange(len(slots)),
            names=self.names.of(self.slots),
            schemas=[self.schemas[slot] for slot in slots],
        )

    # -- what each row is -------------------------------------------------------------

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """``[n, *head]``."""
        return self.flags[..., TERMINATED]

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """``[n, *head]``."""
        return self.flags[..., TRUNCATED]

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Terminated or truncated: ``[n, *head]``."""
        return self.terminated | self.truncated

    @property
    def done(self) -> NDArray[np.bool_]:
        """Terminated, truncated or cut by the step limit: ``[n, *head]``."""
        ended = self.ended
        return ended if self.limit_reached is None else ended | self._spread(self.limit_reached)

    @property
    def is_reset(self) -> NDArray[np.bool_]:
        """No transition ends here: ``[n]``, ``[n, num_envs]`` with sub-environments."""
        resets = self.flags[..., IS_RESET]
        return resets[:, 0] if self.agents else resets

    @property
    def over(self) -> NDArray[np.bool_]:
        """Whether all episodes of an env have ended and none was reset since: ``[n]``."""
        over = self.flags[..., OVER]
        return over if over.ndim == 1 else np.logical_and.reduce(over.reshape(len(over), -1), 1)

    def by_sub_env(self, column: NDArray[Any] | None) -> NDArray[Any]:
        """A column of envs, ``[n]``, in the shape of `is_reset`; None is all False."""
        shape = self.is_reset.shape
        if column is None:
            return np.zeros(shape, np.bool_)
        spread = np.empty(shape, column.dtype)
        spread[...] = column.reshape(len(self), *[1] * (len(shape) - 1))
        return spread

    def _spread(self, column: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return column.reshape(len(self), *[1] * (self.reward.ndim - 1))

    @property
    def index(self) -> NDArray[np.int64]:
        """Place in the group, sub-environments counted: ``[n]`` or ``[n, num_envs]``."""
        names, shape = self.names, self.is_reset.shape
        first: NDArray[np.int64] = names.index_offset[self.slots]
        if len(shape) == 1:
            return first
        num_envs: int = shape[1]
        places = np.add.outer(first, np.arange(num_envs))
        if np.count_nonzero(names.turns):
            for row in np.flatnonzero(names.turns[self.slots]).tolist():
                places[row] = first[row] + self.info_of(row)["env_id"]
        return places

    @property
    def ready_ns(self) -> NDArray[np.int64]:
        """When each result was ready, on the monotonic clock: ``[n]``."""
        return self.times[:, 0]

    @property
    def busy_ns(self) -> NDArray[np.int64]:
        """The time each env took: ``[n]``."""
        return self.times[:, 1]

    # -- one row ----------------------------------------------------------------------

    def out_of_band_of(self, row: int) -> dict[str, Any]:
        """What came out of band for `row`; empty if nothing did."""
        found = self.out_of_band.get(row)
        if isinstance(found, bytes):
            found = self.out_of_band[row] = pickle.loads(found)
        return found or {}

    def observation_of(self, row: int) -> Any:
        """One env's observation."""
        kept = self.out_of_band_of(row) if self.out_of_band else {}
        if "ret" in kept:
            return kept["ret"].observation
        if self.observation is not None:
            return index(self.observation, row)
        return kept["observation"]

    def info_of(self, row: int) -> dict[str, Any]:
        """One env's info, with the episode's sums if it has just ended."""
        info = self.reported_info_of(row)
        episode = self.episode(row)
        return {"episode": episode, **info} if episode else info

    def reported_info_of(self, row: int) -> dict[str, Any]:
        """One env's info, as the env told it."""
        kept = self.out_of_band_of(row) if self.out_of_band else {}
        if "ret" in kept:
            return kept["ret"].info
        return kept["info"] if "info" in kept else self._info_in_row(row)

    def may_hold(self, row: int, keys: Iterable[str]) -> bool:
        """Whether the info of `row` may hold any of `keys`; tells without decoding it."""
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
        """The sums of the episode that has just ended; empty if none has."""
        if self.episode_return is None or self.episode_length is None:
            return {}
        if self.restarted is not None and self.restarted[row]:
            return {}  # It has lost the episode, or goes on with it.
        ended = self.ended[row]
        if self.limit_reached is not None and self.limit_reached[row]:
            ended = np.ones_like(ended)
        lengths = np.where(ended, self.episode_length[row], 0)
        if not np.any(lengths):
            return {}
        returns = self.episode_return[row]
        if ended.ndim == 0:
            return {"r": float(returns), "l": int(lengths)}
        return {"r": returns, "l": lengths, "ended": ended}

    def ret(self, row: int) -> EnvRet | MultiAgentEnvRet:
        """One env's result as a value of its own."""
        kept = self.out_of_band_of(row) if self.out_of_band else {}
        if "ret" in kept:
            return self._ret_handed_over(row, kept["ret"])
        fields = {
            "env_id": self.names.ids(self.slots[row : row + 1])[0],
            "observation": self.observation_of(row),
            "last_reward": self.head_of(self.reward, row),
            "last_terminated": self.head_of(self.terminated, row),
            "last_truncated": self.head_of(self.truncated, row),
            "info": self.info_of(row),
            "ts_env_sent_ns": self.sent_ns_of(row),
        }
        return (MultiAgentEnvRet if self.agents else EnvRet)(_extra=kept.get("extra"), **fields)

    def _ret_handed_over(self, row: int, ret: Any) -> Any:
        changed: dict[str, Any] = {}
        for name in ("reward", "terminated", "truncated"):
            field = f"last_{name}"
            if _stands_for_all(getattr(ret, field)) and self.reward.ndim > 1:
                changed[field] = self.head_of(getattr(self, name), row)
        if self.episode(row):
            changed["info"] = self.info_of(row)
        if self.limit_reached is not None and self.limit_reached[row]:
            # `auto_reset` may have marked the cut.
            changed["last_truncated"] = _like(ret.last_truncated, self.head_of(self.truncated, row))
        return ret.model_copy(update=changed) if changed else ret

    def sent_ns_of(self, row: int) -> int:
        """When one env sent its result, in ns since the epoch."""
        if self.sent_ns is None:
            return int(self.times[row, 0]) + _EPOCH_NS
        return int(self.sent_ns[row])

    def head_of(self, column: NDArray[Any], row: int) -> Any:
        """One env's entry of a column of rewards or ends: a number, an array, a dict by agent."""
        value = column[row]
        if self.agents:
            return {
                agent: part.item() if part.ndim == 0 else part
                for agent, part in zip(self.agents, value, strict=True)
            }
        return value.item() if value.ndim == 0 else value

    # -- parts of it ------------------------------------------------------------------

    def subset(self, rows: Sequence[int], positions: Sequence[int]) -> ResultColumns:
        """Some rows, at other places of another batch."""

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
        """A column of reward or ends, by agent where there are any."""
        array = cast("NDArray[Any]", getattr(self, column))
        if self.agents:
            return {agent: array[:, k] for k, agent in enumerate(self.agents)}
        return array


def _stands_for_all(told: Any) -> bool:
    """Whether a reward or an end was left out, by all sub-environments or by all agents."""
    return type(told) in (float, bool) or (isinstance(told, dict) and not told)


def _like(told: Any, value: Any) -> Any:
    """`value` as what was told in its place: a tensor on its device, or an array."""
    if isinstance(told, dict):
        return {key: _like(part, value[key]) for key, part in cast("dict[str, Any]", told).items()}
    return told.new_tensor(value) if hasattr(told, "new_tensor") else value


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
