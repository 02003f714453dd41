"""`BatchedData`: many envs' results or responses, as ids and columns.

Rule: columns are what travels; an `EnvRet` or a `PolicyResponse` is made only when
somebody asks for it, and an info dict is decoded only when it is read. A batch owns its
arrays: nothing that happens later changes them (unless the group was built with
``zero_copy=True``).
"""

from __future__ import annotations

import pickle
import sys
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from rlightning_aio.errors import BadAction
from rlightning_aio.protocol.columns import Tree, index, is_dict, is_tuple, leaves, mapped
from rlightning_aio.protocol.info import NO_INFO, PICKLED, InfoSchema
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

__all__ = ["BatchedData", "EnvTable", "Origin", "ResultColumns"]


# The monotonic clock's distance to the epoch; workers stamp results with the former.
_EPOCH_NS = time.time_ns() - time.monotonic_ns()


class EnvTable(Protocol):
    """Names of a group's envs, by slot."""

    def ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots`, in order."""
        ...

    def batch_ids(self, slots: NDArray[np.intp]) -> list[str]:
        """Ids of `slots` as a batch has them: a client goes by its server's id."""
        ...

    def names(self, slots: NDArray[np.intp]) -> list[str]:
        """Config entries of `slots`, in order."""
        ...


@dataclass(slots=True)
class ResultColumns:
    """Results of envs whose rows have one layout; every array has them on its first axis.

    Attributes:
        slots: the env of each row, a slot of `table`.
        positions: the place of each row in the batch; None for 0, 1, 2, …
        observation: tree of arrays, or None where observations came one by one (`rests`).
        reward: ``[n, *head]``; ends: ``[n, *head, 2]``, terminated and truncated.
        info_marks, info: see `protocol.info`; None where no env has put any into its row.
        schemas: by slot, its worker's schemas by number.
        rests: what did not fit a row, by row, pickled or plain.
        whole_results: some of these are results handed over whole, which are never pickled.
        episode_return, episode_length: valid where an episode has ended; None if nowhere.
        times: ``[n, 2]``: when each result was ready (monotonic), and the time the env took,
            in ns.
        agents: names of a multi-agent env's agents.
        observation_space: of one env; None if it isn't known.
    """

    slots: NDArray[np.intp]
    table: EnvTable
    positions: NDArray[np.intp] | None
    observation: Tree | None
    reward: NDArray[np.float64]
    ends: NDArray[np.bool_]
    info_marks: NDArray[np.uint8] | None
    info: NDArray[np.uint8] | None
    schemas: Sequence[Mapping[int, InfoSchema]]
    rests: dict[int, Any]
    episode_return: NDArray[np.float64] | None
    episode_length: NDArray[np.int64] | None
    times: NDArray[np.int64]
    agents: tuple[str, ...] = ()
    observation_space: gym.Space[Any] | None = None
    whole_results: bool = False

    def __len__(self) -> int:
        return len(self.slots)

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """``[n, *head]``."""
        return self.ends[..., 0]

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """``[n, *head]``."""
        return self.ends[..., 1]

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Terminated or truncated: ``[n, *head]``."""
        return self.terminated | self.truncated

    @property
    def busy_ns(self) -> NDArray[np.int64]:
        """The time each env took: ``[n]``."""
        return self.times[:, 1]

    def rest(self, row: int) -> dict[str, Any]:
        """What did not fit `row`; empty if it all did."""
        rest = self.rests.get(row)
        if isinstance(rest, bytes):
            rest = self.rests[row] = pickle.loads(rest)
        return rest or {}

    def observation_of(self, row: int) -> Any:
        """One env's observation."""
        rest = self.rest(row) if self.rests else {}
        if "ret" in rest:
            return rest["ret"].observation
        return (
            index(self.observation, row) if self.observation is not None else (rest["observation"])
        )

    def info_of(self, row: int) -> dict[str, Any]:
        """One env's info, with the episode's sums if it has just ended."""
        rest = self.rest(row) if self.rests else {}
        if "ret" in rest:
            info = rest["ret"].info
        elif "info" in rest:
            info = rest["info"]
        else:
            info = self._info_in_row(row)
        episode = self._episode(row)
        return {"episode": episode, **info} if episode else info

    def reports(self, row: int, keys: Iterable[str]) -> bool:
        """Whether the info of `row` may hold any of `keys`; tells without decoding it."""
        mark = self._mark(row)
        if mark in (NO_INFO, PICKLED):
            return row in self.rests
        return not set(keys).isdisjoint(self.schemas[int(self.slots[row])][mark].keys)

    def _mark(self, row: int) -> int:
        return NO_INFO if self.info_marks is None else int(self.info_marks[row])

    def _info_in_row(self, row: int) -> dict[str, Any]:
        mark = self._mark(row)
        if self.info is None or mark in (NO_INFO, PICKLED):
            return {}
        return self.schemas[int(self.slots[row])][mark].decode(memoryview(self.info[row]))

    def _episode(self, row: int) -> dict[str, Any]:
        if self.episode_return is None or self.episode_length is None:
            return {}
        ended = self.ends[row].any(axis=-1)
        if not np.any(ended) or not np.any(self.episode_length[row]):
            return {}
        returns, lengths = self.episode_return[row], self.episode_length[row]
        if ended.ndim == 0:
            return {"r": float(returns), "l": int(lengths)}
        return {"r": returns, "l": lengths, "ended": ended}

    def ret(self, row: int) -> EnvRet | MultiAgentEnvRet:
        """One env's result as a value of its own."""
        rest = self.rest(row) if self.rests else {}
        if "ret" in rest:
            episode = {"info": self.info_of(row)} if self._episode(row) else {}
            return rest["ret"].model_copy(update=episode) if episode else rest["ret"]
        fields = {
            "env_id": self.table.ids(self.slots[row : row + 1])[0],
            "observation": self.observation_of(row),
            "last_reward": self._head(self.reward, row),
            "last_terminated": self._head(self.terminated, row),
            "last_truncated": self._head(self.truncated, row),
            "info": self.info_of(row),
            "ts_env_sent_ns": int(self.times[row, 0]) + _EPOCH_NS,
        }
        return (MultiAgentEnvRet if self.agents else EnvRet)(_extra=rest.get("extra"), **fields)

    def _head(self, column: NDArray[Any], row: int) -> Any:
        value = column[row]
        if self.agents:
            return {
                agent: part.item() if part.ndim == 0 else part
                for agent, part in zip(self.agents, value, strict=True)
            }
        return value.item() if value.ndim == 0 else value


def _by_position(parts: Sequence[ResultColumns], size: int) -> list[tuple[ResultColumns, int]]:
    """For each place in the batch its part and row."""
    places: list[Any] = [None] * size
    for part in parts:
        positions = range(len(part)) if part.positions is None else part.positions.tolist()
        for row, position in enumerate(positions):
            places[position] = (part, row)
    return places


@dataclass(slots=True)
class Origin:
    """Where a batch came from, so that an answer to it finds its way without a look-up."""

    group: object
    slots: NDArray[np.intp]
    table: EnvTable


class BatchedData:
    """Ids and values, in order; an id may come more than once.

    Args:
        ids: one for each value.
        values: `EnvRet`, `MultiAgentEnvRet`, `PolicyResponse`, or anything else.
    """

    __slots__ = ("_columns", "_env_ids", "_ids", "_origin", "_parts", "_values")

    def __init__(self, ids: Sequence[str] = (), values: Sequence[Any] = ()) -> None:
        if len(ids) != len(values):
            raise ValueError(f"{len(ids)} ids for {len(values)} values")
        self._ids: list[str] | None = list(ids)
        self._values: list[Any] | None = list(values)
        self._parts: Sequence[ResultColumns] = ()
        self._columns: dict[str, Any] | None = None
        self._origin: Origin | None = None
        self._env_ids: list[str] | None = None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> BatchedData:
        """A batch of the mapping's items, in its order."""
        return cls(list(values), list(values.values()))

    @classmethod
    def of_results(cls, parts: Sequence[ResultColumns], origin: Origin) -> BatchedData:
        """A batch over columns; for the group's own use."""
        batch = cls.__new__(cls)
        batch._ids = None
        batch._values = None
        batch._parts = parts
        batch._columns = None
        batch._origin = origin
        batch._env_ids = None
        return batch

    def _response(self, columns: dict[str, Any]) -> BatchedData:
        batch = BatchedData.__new__(BatchedData)
        batch._ids = self._ids
        batch._values = None
        batch._parts = ()
        batch._columns = columns
        batch._origin = self._origin
        batch._env_ids = None if self._origin is not None else self.env_ids()
        return batch

    # -- ids and values -----------------------------------------------------------

    def ids(self) -> list[str]:
        """The ids, in order. Results of a remote client carry its server's id."""
        if self._ids is None:
            origin = self._origin
            self._ids = [] if origin is None else origin.table.batch_ids(origin.slots)
        return self._ids

    def env_ids(self) -> list[str]:
        """The env of each value, in order."""
        if self._origin is not None:
            return self._origin.table.ids(self._origin.slots)
        if self._env_ids is not None:
            return self._env_ids
        return [
            getattr(value, "env_id", id_)
            for id_, value in zip(self._ids or (), self._values or (), strict=True)
        ]

    def values(self) -> list[Any]:
        """The values, in order; made on the first call."""
        if self._values is None:
            if self._columns is not None:
                self._values = self._responses(self._columns)
            else:
                places = _by_position(self._parts, len(self))
                self._values = [part.ret(row) for part, row in places]
        return self._values

    def _responses(self, columns: dict[str, Any]) -> list[PolicyResponse]:
        return [
            PolicyResponse(env_id, **{name: index(c, k) for name, c in columns.items()})
            for k, env_id in enumerate(self.env_ids())
        ]

    def items(self) -> list[tuple[str, Any]]:
        """Pairs of id and value, in order."""
        return list(zip(self.ids(), self.values(), strict=True))

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        return iter(self.items())

    def __len__(self) -> int:
        return len(self._origin.slots) if self._origin is not None else len(self.ids())

    def __contains__(self, id_: object) -> bool:
        return id_ in self.ids()

    def __getitem__(self, id_: str) -> Any:
        """The value of `id_`; of the first, if the id comes more than once."""
        try:
            position = self.ids().index(id_)
        except ValueError:
            raise KeyError(id_) from None
        return self.values()[position]

    def __repr__(self) -> str:
        return f"BatchedData({len(self)} of {self.ids()[:4]}{'…' if len(self) > 4 else ''})"

    # -- columns of results -------------------------------------------------------

    @property
    def observation(self) -> Any:
        """Observations stacked: ``[n, *obs]``, or dicts and tuples of such arrays.

        What has no fixed size (Text, Sequence, Graph) comes as a list of n values.

        Raises:
            ValueError: the envs have different observation spaces; use `by_name`.
        """
        if len(self._parts) == 1 and not self._parts[0].whole_results:
            part = self._parts[0]
            if part.observation is not None:
                return part.observation
            values = [part.observation_of(row) for row in range(len(part))]
            return _columns(part.observation_space, values)
        if self._parts:
            places = _by_position(self._parts, len(self))
            return _stacked([part.observation_of(row) for part, row in places])
        return _stacked([value.observation for value in self.values()])

    @property
    def reward(self) -> Any:
        """Rewards: ``[n]`` float64, ``[n, num_envs]``, or a dict of such by agent."""
        return self._head("reward", "last_reward")

    @property
    def terminated(self) -> Any:
        """Terminations: ``[n]`` bool, ``[n, num_envs]``, or a dict of such by agent."""
        return self._head("terminated", "last_terminated")

    @property
    def truncated(self) -> Any:
        """Truncations by the env: ``[n]`` bool, ``[n, num_envs]``, or a dict by agent."""
        return self._head("truncated", "last_truncated")

    def _head(self, column: str, attribute: str) -> Any:
        if len(self._parts) == 1 and not self._parts[0].whole_results:
            part = self._parts[0]
            array = getattr(part, column)
            if part.agents:
                return {agent: array[:, k] for k, agent in enumerate(part.agents)}
            return array
        return _stacked([getattr(value, attribute) for value in self.values()])

    @property
    def any_ended(self) -> bool:
        """Whether any episode has ended, of a sub-environment or agent included."""
        return any(part.episode_return is not None for part in self._parts)

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Which envs' episodes have ended: ``[n]`` bool, all sub-environments and agents of it."""
        whole = np.empty(len(self), np.bool_)
        for part in self._parts:
            ended = part.ended
            if ended.ndim > 1:
                ended = np.logical_and.reduce(ended, axis=tuple(range(1, ended.ndim)))
            if part.positions is None:
                return ended
            whole[part.positions] = ended
        return whole

    @property
    def parts(self) -> Sequence[ResultColumns]:
        """The columns, one set for each layout; empty for a batch of plain values."""
        return self._parts

    @property
    def info(self) -> list[dict[str, Any]]:
        """One info for each result, decoded now."""
        if self._parts:
            return [part.info_of(row) for part, row in _by_position(self._parts, len(self))]
        return [value.info for value in self.values()]

    def by_name(self) -> dict[str, BatchedData]:
        """One batch for each config entry; each of them stacks."""
        names = self._names()
        positions: dict[str, list[int]] = {}
        for position, name in enumerate(names):
            positions.setdefault(name, []).append(position)
        return {name: self._taken(chosen) for name, chosen in positions.items()}

    def _names(self) -> list[str]:
        if self._origin is not None:
            return self._origin.table.names(self._origin.slots)
        return [id_.rpartition("-")[0] or id_ for id_ in self.ids()]

    def _taken(self, chosen: list[int]) -> BatchedData:
        """The values at the chosen places."""
        if self._origin is None:
            ids, values = self.ids(), self.values()
            return BatchedData([ids[k] for k in chosen], [values[k] for k in chosen])
        rows: dict[int, list[int]] = {}
        positions: dict[int, list[int]] = {}
        places = _by_position(self._parts, len(self))
        for position, k in enumerate(chosen):
            part, row = places[k]
            rows.setdefault(id(part), []).append(row)
            positions.setdefault(id(part), []).append(position)
        parts = [
            _subset(part, rows[id(part)], positions[id(part)])
            for part in self._parts
            if id(part) in rows
        ]
        origin = Origin(self._origin.group, self._origin.slots[chosen], self._origin.table)
        return BatchedData.of_results(parts, origin)

    def slots_in(self, group: object) -> NDArray[np.intp] | None:
        """Slots of the envs, if this batch is of `group`'s own making."""
        origin = self._origin
        return origin.slots if origin is not None and origin.group is group else None

    # -- columns of responses -----------------------------------------------------

    def respond(self, action: Any, **extras: Any) -> BatchedData:
        """The matching batch of responses, from columns.

        Args:
            action: ``[n, *action]`` (a dict or tuple of such arrays for Dict and Tuple
                spaces, a list where actions don't stack).
            extras: further columns of n rows (``log_prob``, ``value``, …).

        Raises:
            BadAction: a column has not as many rows as this batch has results.
        """
        columns = {"action": action, **extras}
        for name, column in columns.items():
            mapped(lambda leaf, name=name: self._check_rows(name, leaf), column)
        return self._response(columns)

    def _check_rows(self, name: str, column: Any) -> None:
        try:
            rows = len(column)
        except TypeError:
            rows = 0
        if rows != len(self):
            raise BadAction(
                f"column {name!r} has {rows} rows for a batch of {len(self)}; give one row for "
                "each result, in the batch's order"
            )

    @property
    def response_columns(self) -> Mapping[str, Any] | None:
        """Columns of a batch made by `respond`; None for any other batch."""
        return self._columns

    @property
    def action(self) -> Any:
        """Actions of a batch of responses, stacked."""
        if self._columns is not None:
            return self._columns["action"]
        return _stacked([value.action for value in self.values()])


def _subset(part: ResultColumns, rows: list[int], positions: list[int]) -> ResultColumns:
    def taken(array: Any) -> Any:
        return None if array is None else array[rows]

    return replace(
        part,
        slots=part.slots[rows],
        positions=np.asarray(positions, np.intp),
        observation=None if part.observation is None else mapped(taken, part.observation),
        reward=taken(part.reward),
        ends=taken(part.ends),
        info_marks=taken(part.info_marks),
        info=taken(part.info),
        rests={k: part.rests[row] for k, row in enumerate(rows) if row in part.rests},
        episode_return=taken(part.episode_return),
        episode_length=taken(part.episode_length),
        times=taken(part.times),
    )


def _columns(space: gym.Space[Any] | None, values: list[Any]) -> Any:
    """`values` of `space` as columns."""
    if space is not None and is_dict(space):
        parts = space.spaces.items()
        return {key: _columns(inner, [value[key] for value in values]) for key, inner in parts}
    if space is not None and is_tuple(space):
        return tuple(
            _columns(inner, [value[k] for value in values]) for k, inner in enumerate(space.spaces)
        )
    return values if space is not None and leaves(space) is None else _stacked(values)


def _stacked(values: list[Any]) -> Any:
    """`values` as columns: arrays, torch tensors, and dicts and tuples of them.

    Raises:
        ValueError: they differ in structure or shape.
    """
    first = values[0] if values else None
    if isinstance(first, dict):
        keys = cast("dict[Any, Any]", first).keys()
        if not all(isinstance(value, dict) and value.keys() == keys for value in values):
            raise _differing()
        return {key: _stacked([value[key] for value in values]) for key in keys}
    if isinstance(first, tuple):
        if not all(isinstance(value, tuple) for value in values):
            raise _differing()
        tuples = cast("list[tuple[Any, ...]]", values)
        length = len(tuples[0])
        if any(len(value) != length for value in tuples):
            raise _differing()
        return tuple(_stacked([value[k] for value in tuples]) for k in range(length))
    if isinstance(first, str):
        return values
    if type(first).__module__.partition(".")[0] == "torch":
        # Whoever holds a tensor has imported torch.
        return sys.modules["torch"].stack(values)
    arrays = [np.asarray(value) for value in values]
    if len({array.shape for array in arrays}) > 1:
        raise _differing()
    return np.stack(arrays) if arrays else np.empty(0)


def _differing() -> ValueError:
    return ValueError(
        "envs of this batch have different shapes, so their values don't stack; use by_name()"
    )
