"""`BatchedData` itself, and what only groups do with one; see the package."""

# The functions at the end are the class's own, and none of its users' business.
# pyright: reportPrivateUsage=false

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np

from rlightning_aio.batch.infos import (
    info_list_of_rows,
    infos_of_rows,
    sub_env_infos_of_rows,
    vector_infos,
)
from rlightning_aio.batch.sent import Sent, taken_sources
from rlightning_aio.batch.stacking import columns_where_possible, differing, stacked_values
from rlightning_aio.errors import BadAction
from rlightning_aio.protocol.columns import index, is_dict, is_tuple, leaves, mapped
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.batch.names import EnvNames
    from rlightning_aio.batch.sent import Sources

__all__ = [
    "BatchedData",
    "Origin",
    "batch_of_results",
    "columns_of_responses",
    "names_of",
    "origin_of",
    "parts_of",
    "reported_info_list",
    "reported_infos",
    "reported_sub_env_infos",
    "slots_of",
    "sources_of",
]

_MISSING: Any = object()


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
    names: EnvNames


class BatchedData:
    """Ids and values, in order; an id may come more than once.

    Args:
        ids: one for each value.
        values: `EnvRet`, `MultiAgentEnvRet`, `PolicyResponse`, or anything else.
    """

    __slots__ = (
        "_columns", "_env_ids", "_ids", "_infos", "_origin", "_parts", "_sources", "_values",
    )  # fmt: skip

    def __init__(self, ids: Sequence[str] = (), values: Sequence[Any] = ()) -> None:
        if len(ids) != len(values):
            raise ValueError(f"{len(ids)} ids for {len(values)} values")
        self._ids: list[str] | None = list(ids)
        self._values: list[Any] | None = list(values)
        self._parts: Sequence[ResultColumns] = ()
        self._columns: dict[str, Any] | None = None
        self._origin: Origin | None = None
        self._env_ids: list[str] | None = None
        self._sources: Sources | None = None
        self._infos: dict[str, Any] | None = None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> BatchedData:
        """A batch of the mapping's items, in its order."""
        return cls(list(values), list(values.values()))

    def _response(self, columns: dict[str, Any]) -> BatchedData:
        batch = _blank()
        batch._ids = self._ids
        batch._columns = columns
        batch._origin = self._origin
        batch._env_ids = None if self._origin is not None else self.env_ids()
        return batch

    # -- copies ---------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """What copies and pickles hold: all but the group, which then goes by the ids."""
        state = {name: getattr(self, name) for name in self.__slots__}
        origin = self._origin
        if origin is not None:
            names, slots = origin.names.of(origin.slots), np.arange(len(origin.slots))
            state["_origin"] = Origin(None, slots, names)
            state["_parts"] = [part.apart() for part in self._parts]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    # -- ids and values -----------------------------------------------------------

    def ids(self) -> list[str]:
        """The ids, in order. Results of a client carry its env_server's id, each the same.

        The list is the batch's own: change a copy.
        """
        if self._ids is None:
            origin = self._origin
            self._ids = [] if origin is None else origin.names.batch_ids(origin.slots)
        return self._ids

    def env_ids(self) -> list[str]:
        """The env of each value, in order; a client's is ``<server id>/<client name>``."""
        if self._origin is not None:
            return self._origin.names.ids(self._origin.slots)
        if self._env_ids is not None:
            return self._env_ids
        return [
            getattr(value, "env_id", id_)
            for id_, value in zip(self._ids or (), self._values or (), strict=True)
        ]

    def values(self) -> list[Any]:
        """The values, in order; made on the first call, and the same ones afterwards.

        Results are `EnvRet` or `MultiAgentEnvRet`, whose arrays may be views of the columns;
        responses are `PolicyResponse`.
        """
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
        """The value of `id_`; of the first, if the id comes more than once.

        Raises:
            KeyError: the batch has no such id.
        """
        try:
            position = self.ids().index(id_)
        except ValueError:
            raise KeyError(id_) from None
        return self.values()[position]

    def __repr__(self) -> str:
        return f"BatchedData({', '.join([self._described(), *self._shapes()])})"

    def _described(self) -> str:
        kind = "results" if self._parts else "responses" if self._columns is not None else "values"
        ids = self.ids()
        return f"{len(self)} {kind} of {', '.join(ids[:3])}{', …' if len(ids) > 3 else ''}"

    def _shapes(self) -> Iterator[str]:
        """What the columns look like, as ``name: dtype[shape]``."""
        if self._columns is not None:
            for name, column in self._columns.items():
                yield f"{name}: {_shape(column)}"
        for part in self._parts:
            observation = "…" if part.observation is None else _shape(part.observation)
            yield f"observation: {observation}, reward: {_shape(part.reward)}"

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
            return stacked_values([part.observation_of(row) for part, row in places])
        return stacked_values([value.observation for value in self.values()])

    @property
    def reward(self) -> Any:
        """Rewards: ``[n]`` float64, ``[n, num_envs]``, or a dict of such by agent."""
        return self._head("reward", "last_reward")

    @property
    def terminated(self) -> Any:
        """Terminations by the env: ``[n]`` bool, ``[n, num_envs]``, or a dict by agent."""
        return self._head("terminated", "last_terminated")

    @property
    def truncated(self) -> Any:
        """Truncations: ``[n]`` bool, ``[n, num_envs]``, or a dict of such by agent.

        By the env; also true where the step limit cut the episode, if `auto_reset` was told to
        mark that, and where `restarted` is.
        """
        return self._head("truncated", "last_truncated")

    def _head(self, column: str, attribute: str) -> Any:
        if len(self._parts) == 1 and not self._parts[0].whole_results:
            return self._parts[0].stacked_head(column)
        return stacked_values([getattr(value, attribute) for value in self.values()])

    # -- what each row is ---------------------------------------------------------

    @property
    def done(self) -> Any:
        """Terminated, truncated, or cut by the step limit of `auto_reset`.

        ``[n]`` bool, ``[n, num_envs]`` with sub-environments, a dict of such by agent.
        """
        if len(self._parts) == 1 and not self._parts[0].whole_results:
            return self._parts[0].stacked_head("done")
        if not len(self):
            return self.limit_reached
        return _either(_either(self.terminated, self.truncated), self.limit_reached)

    @property
    def is_reset(self) -> NDArray[np.bool_]:
        """Whether the row is the first observation of an episode, where no transition ends.

        True after a reset that you asked for, after one that `auto_reset` or the simulator itself
        put in place of a step, for a client's first result, and for the result that marks a
        replaced worker or a lost client. ``[n]`` bool, ``[n, num_envs]`` with
        sub-environments.

        Raises:
            AttributeError: the batch holds plain values, not results of a group.
            ValueError: the envs have different numbers of sub-environments; use `by_name`.
        """
        return self._by_row(lambda part: part.is_reset)

    @property
    def limit_reached(self) -> NDArray[np.bool_]:
        """Whether the step limit of `auto_reset` cut the episode; shaped as `is_reset`.

        `collect_async` returns the same flags, one for each env.
        """
        return self._by_row(lambda part: part.by_sub_env(part.limit_reached))

    @property
    def restarted(self) -> NDArray[np.bool_]:
        """Whether the previous episode was lost with its worker or client; shaped as `is_reset`.

        A learner that stores transitions cuts the env's chain there.
        """
        return self._by_row(lambda part: part.by_sub_env(part.restarted))

    @property
    def index(self) -> NDArray[np.int64]:
        """Each row's place in the group: ``[n]``, ``[n, num_envs]`` with sub-environments.

        It is the place among `EnvGroup.env_ids`, counting sub-environments where there are any.
        Clients of an env_server come after the local envs; each keeps its place while the group
        lives.
        """
        return self._by_row(lambda part: part.index).astype(np.int64, copy=False)

    @property
    def ready_ns(self) -> NDArray[np.int64]:
        """When each result was ready, by `time.monotonic_ns`; ``[n]``, one for each env."""
        return self._by_row(lambda part: part.ready_ns)

    @property
    def busy_ns(self) -> NDArray[np.int64]:
        """How long each env worked on its step or reset, in ns; ``[n]``, one for each env."""
        return self._by_row(lambda part: part.busy_ns)

    def _by_row(self, column: Callable[[ResultColumns], Any]) -> NDArray[Any]:
        """A column that every part has, in the batch's order."""
        if self._origin is not None and self._columns is None and not len(self):
            return np.zeros(0, np.bool_)
        if not self._parts:
            raise AttributeError("only results of a group have this; this batch holds plain values")
        found = [(part, column(part)) for part in self._parts]
        if self._parts[0].positions is None:
            return found[0][1]
        if len({array.shape[1:] for _, array in found}) > 1:
            raise differing()
        first = found[0][1]
        whole = np.empty((len(self), *first.shape[1:]), first.dtype)
        for part, array in found:
            whole[part.positions] = array
        return whole

    @property
    def sent(self) -> Sent:
        """What `respond` attached to the requests that these rows answer.

        ``batch.sent.log_prob``, ``batch.sent.action``, …: columns in the batch's order, which
        have stayed in this process. See `Sent`.

        Raises:
            AttributeError: the batch holds plain values, not results of a group.
        """
        if self._sources is None:
            raise AttributeError("only results of a group know what was sent for them")
        return Sent(self._sources, len(self))

    @property
    def infos(self) -> dict[str, Any]:
        """Infos as columns, in Gymnasium's vector form; made when it is first read.

        ``infos[key]`` is a typed array ``[n, ...]`` (of objects, where the values are not
        numbers), ``infos["_" + key]`` tells which rows have the key; nested dicts likewise.
        """
        if self._infos is None:
            self._infos = _infos_of(self, episodes=True)
        return self._infos

    @overload
    def info(self) -> list[dict[str, Any]]: ...

    @overload
    def info(self, key: str, default: Any = ...) -> Any: ...

    def info(self, key: str | None = None, default: Any = _MISSING) -> Any:
        """One value of every info as a column; without a key, the infos themselves.

        Args:
            key: of the infos.
            default: in rows whose info lacks the key.

        Returns:
            ``[n, ...]``, a list where the values don't stack; or one dict for each result,
            decoded now.

        Raises:
            KeyError: an info lacks the key, and there is no default.
        """
        if self._parts:
            infos = [part.info_of(row) for part, row in _by_position(self._parts, len(self))]
        else:
            infos = [value.info for value in self.values()]
        if key is None:
            return infos
        if default is _MISSING:
            for env_id, info in zip(self.env_ids(), infos, strict=True):
                if key not in info:
                    raise KeyError(f"the info of {env_id} has no {key!r}; give a default")
        values = [info.get(key, default) for info in infos]
        return columns_where_possible(values)

    # -- parts of a batch ---------------------------------------------------------

    def by_name(self) -> dict[str, BatchedData]:
        """One batch for each config entry, in the order in which entries first come.

        Each of them stacks, and keeps the order of its values.
        """
        names = self._names()
        positions: dict[str, list[int]] = {}
        for position, name in enumerate(names):
            positions.setdefault(name, []).append(position)
        return {name: self.take(chosen) for name, chosen in positions.items()}

    def _names(self) -> list[str]:
        if self._origin is not None:
            return self._origin.names.names(self._origin.slots)
        return [id_.rpartition("-")[0] or id_ for id_ in self.ids()]

    def take(self, rows: Sequence[int]) -> BatchedData:
        """The results (or values) at the places `rows`, in that order, in fresh columns."""
        chosen = list(rows)
        if self._origin is None:
            ids, values = self.ids(), self.values()
            return BatchedData([ids[k] for k in chosen], [values[k] for k in chosen])
        rows_of: dict[int, list[int]] = {}
        positions: dict[int, list[int]] = {}
        places = _by_position(self._parts, len(self))
        for position, k in enumerate(chosen):
            part, row = places[k]
            rows_of.setdefault(id(part), []).append(row)
            positions.setdefault(id(part), []).append(position)
        parts = [
            part.subset(rows_of[id(part)], positions[id(part)])
            for part in self._parts
            if id(part) in rows_of
        ]
        if len(parts) == 1:
            parts[0].positions = None
        origin = Origin(self._origin.group, self._origin.slots[chosen], self._origin.names)
        sources = self._sources
        if sources is not None:
            sources = taken_sources(sources, chosen)
        return batch_of_results(parts, origin, sources)

    # -- columns of responses -----------------------------------------------------

    def respond(self, action: Any, **extras: Any) -> BatchedData:
        """The matching batch of responses, from columns, which it holds uncopied.

        Args:
            action: ``[n, *action]`` (a dict or tuple of such arrays for Dict and Tuple
                spaces), or a list with one action for each result.
            extras: further columns of n rows (``log_prob``, ``value``, …).

        Raises:
            BadAction: a column's number of rows is not this batch's number of results.
        """
        columns = {"action": action, **extras}
        for name, column in columns.items():
            mapped(lambda leaf, name=name: self._check_rows(name, leaf), column)
        return self._response(columns)

    def _check_rows(self, name: str, column: Any) -> None:
        try:
            rows = len(column)
        except TypeError:
            rows = None
        if rows != len(self):
            found = f"is {column!r}" if rows is None else f"has {rows} rows"
            raise BadAction(
                f"column {name!r} {found} for a batch of {len(self)}; give one row for "
                "each result, in the batch's order"
            )

    @property
    def action(self) -> Any:
        """Actions of a batch of responses: ``[n, *action]``, or dicts, tuples, lists of such.

        Raises:
            AttributeError: the batch holds results, which have none; see `sent`.
        """
        if self._columns is not None:
            return self._columns["action"]
        return stacked_values([value.action for value in self.values()])


def batch_of_results(
    parts: Sequence[ResultColumns], origin: Origin, sources: Sources | None = None
) -> BatchedData:
    """A batch over columns, one set for each layout.

    Args:
        parts: each with the places of its rows, unless it is the only one.
        origin: the group that hands it out.
        sources: what its rows answer, see `Sent`.
    """
    batch = _blank()
    batch._parts = parts
    batch._origin = origin
    batch._sources = sources
    return batch


def _blank() -> BatchedData:
    """A batch whose ids and values are still to be made."""
    batch = BatchedData.__new__(BatchedData)
    batch._ids = batch._values = batch._columns = batch._origin = None
    batch._env_ids = batch._sources = batch._infos = None
    batch._parts = ()
    return batch


def reported_infos(batch: BatchedData) -> dict[str, Any]:
    """`BatchedData.infos` of a batch of results, without the sums of episodes."""
    return _infos_of(batch, episodes=False)


def reported_sub_env_infos(batch: BatchedData, num_envs: int) -> dict[str, Any]:
    """`reported_infos` of envs of `num_envs` sub-environments each, as of one row of envs.

    All are of one layout, in the group's order.
    """
    (part,) = batch._parts
    return sub_env_infos_of_rows(part, num_envs)


def reported_info_list(batch: BatchedData) -> list[dict[str, Any]]:
    """`BatchedData.info` of a batch of results, without the sums of episodes."""
    parts = batch._parts
    if len(parts) == 1 and parts[0].positions is None:
        return info_list_of_rows(parts[0])
    return [part.reported_info_of(row) for part, row in _by_position(parts, len(batch))]


def _infos_of(batch: BatchedData, *, episodes: bool) -> dict[str, Any]:
    parts = batch._parts
    if len(parts) == 1 and parts[0].positions is None:
        return infos_of_rows(parts[0], episodes=episodes)
    return vector_infos(batch.info() if episodes or not parts else reported_info_list(batch))


def parts_of(batch: BatchedData) -> Sequence[ResultColumns]:
    """The columns of a batch of results; empty for any other batch."""
    return batch._parts


def slots_of(batch: BatchedData, group: object) -> NDArray[np.intp] | None:
    """Slots of the envs, if the batch is of `group`'s own making."""
    origin = batch._origin
    return origin.slots if origin is not None and origin.group is group else None


def origin_of(batch: BatchedData) -> Origin | None:
    """Where the results of `batch` came from; None for plain values."""
    return batch._origin


def sources_of(batch: BatchedData) -> Sources | None:
    """What the results of `batch` answer; None for any other batch."""
    return batch._sources


def names_of(batch: BatchedData) -> EnvNames | None:
    """The names of its group's envs when it was handed out; None for plain values."""
    return None if batch._origin is None else batch._origin.names


def columns_of_responses(batch: BatchedData) -> Mapping[str, Any] | None:
    """Columns of a batch made by `BatchedData.respond`; None for any other batch."""
    return batch._columns


def _shape(tree: Any) -> str:
    """Dtype and shape of what a column consists of."""
    if isinstance(tree, dict):
        items = cast("dict[str, Any]", tree).items()
        return f"{{{', '.join(f'{key}: {_shape(part)}' for key, part in items)}}}"
    if isinstance(tree, tuple):
        return f"({', '.join(map(_shape, cast('tuple[Any, ...]', tree)))})"
    if hasattr(tree, "shape"):
        return f"{str(tree.dtype).removeprefix('torch.')}{list(tree.shape)}"
    return f"list[{len(tree)}]"


def _either(one: Any, other: Any) -> Any:
    """``one | other``, by agent where there are any."""
    if isinstance(one, dict):
        parts = cast("dict[str, Any]", one)
        theirs = cast("Any", other) if isinstance(other, dict) else dict.fromkeys(parts, other)
        return {agent: _either(part, theirs[agent]) for agent, part in parts.items()}
    return one | other


def _columns(space: gym.Space[Any] | None, values: list[Any]) -> Any:
    """`values` of `space` as columns."""
    if space is not None and is_dict(space):
        parts = space.spaces.items()
        return {key: _columns(inner, [value[key] for value in values]) for key, inner in parts}
    if space is not None and is_tuple(space):
        return tuple(
            _columns(inner, [value[k] for value in values]) for k, inner in enumerate(space.spaces)
        )
    return values if space is not None and leaves(space) is None else stacked_values(values)
