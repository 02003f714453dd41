"""`BatchedData`, and the functions by which this library makes batches and reads what users don't.

The functions below the class use its private attributes, and nothing else does.
"""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import re
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Protocol, overload

import msgspec
import numpy as np
from numpy.typing import NDArray

from rlightning_aio.batch.columns import EnvNames
from rlightning_aio.batch.infos import vector_infos
from rlightning_aio.batch.parts import (
    all_agents,
    column_of_parts,
    in_order,
    infos_of_parts,
    observations_of_parts,
    rets_of,
    rows_in_order,
    shapes,
    taken_parts,
)
from rlightning_aio.batch.sent import Sent, taken_sources
from rlightning_aio.batch.stacking import columns_where_possible, stacked_values
from rlightning_aio.errors import BadAction
from rlightning_aio.outcomes import own_end
from rlightning_aio.trees import index, mapped, zipped
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.batch.sent import Sources

_MISSING: Any = object()
_ID_IN_ENTRY: Final = re.compile("-[0-9]+(?:/.*)?$", re.DOTALL)
"""The end of an env's id: its number in the entry, and the name of a place."""


class Issuer(Protocol):
    """Stands for a group that returns batches: its `Tables`."""

    def stop_hardware(self, slots: Iterable[int]) -> None:
        """Stop what the envs of `slots` move, because their batch was refused."""
        ...


class Origin(msgspec.Struct):
    """Group and slots of a batch, so that the answer to it needs no look-up.

    Attributes:
        issuer: stands for the group that has returned it.
        repeats: True if `slots` may have an env twice; the group then looks the envs up.
    """

    issuer: Issuer | None
    slots: NDArray[np.intp]
    names: EnvNames
    repeats: bool = False


class BatchedData:
    """Ids and values, in order; ids may repeat.

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
        """Make a batch of the items of a mapping, in its order."""
        return cls(list(values), list(values.values()))

    # -- copies ---------------------------------------------------------------------

    def __getstate__(self) -> tuple[None, dict[str, Any]]:
        """Copies and pickles have everything but the group, which then uses the ids."""
        state = {name: getattr(self, name) for name in self.__slots__}
        origin = self._origin
        if origin is not None:
            names, slots = origin.names.of(origin.slots), np.arange(len(origin.slots))
            state["_origin"] = Origin(None, slots, names)
            state["_parts"] = [part.apart() for part in self._parts]
        return None, state

    # -- ids and values -----------------------------------------------------------

    def ids(self) -> list[str]:
        """Ids, in order.

        The batch owns the list: don't change it.
        """
        if self._ids is None:
            origin = self._origin
            self._ids = [] if origin is None else origin.names.ids(origin.slots)
        return self._ids

    def env_ids(self) -> list[str]:
        """Env id of each value, in order; that of a client is ``<server id>/<place>``."""
        if self._origin is not None:
            return self._origin.names.ids(self._origin.slots)
        if self._env_ids is not None:
            return self._env_ids
        return [
            getattr(value, "env_id", id_)
            for id_, value in zip(self._ids or (), self._values or (), strict=True)
        ]

    def values(self) -> list[Any]:
        """Values, in order. The first call makes them; later calls return the same.

        Results are `EnvRet` or `MultiAgentEnvRet`, whose arrays may be views of the columns;
        responses are `PolicyResponse`.
        """
        if self._values is None:
            if self._columns is not None:
                self._values = _policy_responses(self._columns, self.env_ids())
            else:
                self._values = in_order(self._parts, [rets_of(part) for part in self._parts])
        return self._values

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
        """The value of `id_`; the first one if the id repeats.

        Raises:
            KeyError: the batch has no such id.
        """
        try:
            position = self.ids().index(id_)
        except ValueError:
            raise KeyError(id_) from None
        return self.values()[position]

    def __repr__(self) -> str:
        kind = "results" if self._parts else "values" if self._columns is None else "responses"
        ids = self.ids()
        described = f"{len(self)} {kind} of {', '.join(ids[:3])}{', …' if len(ids) > 3 else ''}"
        return f"BatchedData({', '.join([described, *shapes(self._columns or {}, self._parts)])})"

    # -- columns of results -------------------------------------------------------

    @property
    def observation(self) -> Any:
        """Stacked observations: ``[n, *obs]``, or dicts and tuples of such arrays.

        Values without fixed size (Text, Sequence, Graph) are a list of n.

        Raises:
            ValueError: the envs have different observation spaces; use `by_entry`.
        """
        parts = self._parts
        if parts:
            columns = None if len(parts) > 1 else parts[0].observation
            return observations_of_parts(parts) if columns is None else columns
        return stacked_values([value.observation for value in self.values()])

    @property
    def reward(self) -> Any:
        """Rewards: ``[n]`` float64, ``[n, num_envs]``, or a dict of such by agent."""
        return _head(self, "reward", "last_reward")

    @property
    def terminated(self) -> Any:
        """Terminations: ``[n]`` bool, ``[n, num_envs]``, or a dict of such by agent."""
        return _head(self, "terminated", "last_terminated")

    @property
    def truncated(self) -> Any:
        """Truncations: ``[n]`` bool, ``[n, num_envs]``, or a dict of such by agent.

        Set by the env, by the step limit of `auto_reset`, and where `restarted` is True.
        """
        return _head(self, "truncated", "last_truncated")

    # -- flags and times of rows --------------------------------------------------

    @property
    def done(self) -> Any:
        """Terminated or truncated: the episode is over.

        ``[n]`` bool, ``[n, num_envs]`` with sub-environments, or a dict of such by agent.
        """
        if len(self._parts) == 1:
            return self._parts[0].stacked_head("done")
        return zipped(np.bitwise_or, self.terminated, self.truncated)

    @property
    def is_reset(self) -> NDArray[np.bool_]:
        """True for the first observation of an episode, where no transition ends.

        These are results of a requested reset, of a reset that `auto_reset` or the simulator did
        in place of a step, and of a replaced worker or a lost client.
        ``[n]`` bool, ``[n, num_envs]`` with sub-environments.

        Raises:
            AttributeError: the batch holds plain values, not results of a group.
            ValueError: the envs have different numbers of sub-environments; use `by_entry`.
        """
        return _by_row(self, lambda part: part.is_reset)

    @property
    def limit_reached(self) -> NDArray[np.bool_]:
        """True if the step limit of `auto_reset` cut the episode; shaped like `is_reset`.

        `collect_async` returns the same flags, one for each env.
        """
        return _by_row(self, lambda part: part.by_sub_env(part.limit_reached))

    @property
    def restarted(self) -> NDArray[np.bool_]:
        """True if the previous episode was lost; shaped like `is_reset`.

        A learner that stores transitions must cut the env's chain there.
        """
        return _by_row(self, lambda part: part.by_sub_env(part.restarted))

    @property
    def outcome(self) -> NDArray[np.object_]:
        """`Outcome` of the episode that ended with each row, or None; shaped like `is_reset`.

        Where `restarted` is True, that is the episode before, which is lost. An env may say more
        than its flags do by an `Outcome` in its info, as ``outcome``, where it ends an episode.
        """
        over = all_agents(self.done) | self.restarted
        found = np.full(over.shape, None, np.object_)
        if not over.any():
            return found
        rows: list[int] = np.flatnonzero(over.reshape(len(over), -1).any(axis=1)).tolist()
        terminated, cut, env_ids = all_agents(self.terminated), self.limit_reached, self.env_ids()
        for row, info in zip(rows, self.take(rows).info(), strict=True):
            for place in np.argwhere(over[row]).tolist():  # One, and empty, without sub-envs.
                where = (row, *place)
                cause = "it reached the step limit" if cut[where] else "its env cut it"
                ended = bool(terminated[where])
                found[where] = own_end(env_ids[row], info, terminated=ended, cut=cause)
        return found

    @property
    def index(self) -> NDArray[np.int64]:
        """Position of each row in the group: ``[n]``, ``[n, num_envs]`` with sub-environments.

        It counts sub-environments in the order of `EnvGroup.env_ids`: the places of env_servers
        come after the local envs. Each keeps its position during the life of the group.
        """
        return _by_row(self, lambda part: part.index).astype(np.int64, copy=False)

    @property
    def ready_ns(self) -> NDArray[np.int64]:
        """``[n]``, time when the result of each env was ready, by `time.monotonic_ns`."""
        return _by_row(self, lambda part: part.ready_ns)

    @property
    def busy_ns(self) -> NDArray[np.int64]:
        """``[n]``, duration of the step or reset of each env, in ns."""
        return _by_row(self, lambda part: part.busy_ns)

    @property
    def sent(self) -> Sent:
        """Columns of the responses that these rows answer: ``batch.sent.log_prob``, …; see `Sent`.

        Raises:
            AttributeError: the batch holds plain values, not results of a group.
        """
        if self._sources is None:
            raise AttributeError("only results of a group know what was sent for them")
        return Sent(self._sources, len(self))

    @property
    def infos(self) -> dict[str, Any]:
        """Infos as columns, in the form of Gymnasium's vector envs; made when first read.

        ``infos[key]`` is an array ``[n, ...]``, of objects if the values are not numbers;
        ``infos["_" + key]`` is the mask of rows with the key; nested dicts likewise.
        """
        if self._infos is None:
            self._infos = (
                infos_of_parts(self._parts, episodes=True)
                if self._parts
                else vector_infos(self.info())
            )
        return self._infos

    @overload
    def info(self) -> list[dict[str, Any]]: ...

    @overload
    def info(self, key: str, default: Any = ...) -> Any: ...

    def info(self, key: str | None = None, default: Any = _MISSING) -> Any:
        """Column of one key of the infos; without a key, the infos themselves.

        Args:
            key: of the infos.
            default: for rows without the key.

        Returns:
            ``[n, ...]``, or a list if the values don't stack; without a key, one dict for each
            result.

        Raises:
            KeyError: an info lacks the key, and no default was given.
        """
        if self._parts:
            infos = [part.info_of(row) for part, row in rows_in_order(self._parts)]
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

    def by_entry(self) -> dict[str, BatchedData]:
        """Split by config entry, in the order of first appearance; values keep their order."""
        if self._origin is None:
            names = [_entry_of(id_) for id_ in self.ids()]
        else:
            names = self._origin.names.names(self._origin.slots)
        positions: dict[str, list[int]] = {}
        for position, name in enumerate(names):
            positions.setdefault(name, []).append(position)
        return {name: self.take(chosen) for name, chosen in positions.items()}

    def take(self, rows: Sequence[int]) -> BatchedData:
        """Copy the results, responses or values at the positions `rows`, in that order."""
        chosen = list(rows)
        if self._columns is not None:
            return _taken_responses(self, self._columns, chosen)
        if self._origin is None:
            ids, values = self.ids(), self.values()
            return BatchedData([ids[k] for k in chosen], [values[k] for k in chosen])
        parts = taken_parts(self._parts, chosen)
        origin, sources = self._origin, self._sources
        if sources is not None:
            sources = taken_sources(sources, chosen)
        slots = origin.slots[chosen]
        return with_repeats(batch_of_results(parts, origin.issuer, slots, origin.names, sources))

    # -- columns of responses -----------------------------------------------------

    def respond(self, action: Any, **extras: Any) -> BatchedData:
        """Make the batch of responses to these results, from columns that are not copied.

        Args:
            action: ``[n, *action]`` (a dict or tuple of such arrays for Dict and Tuple
                spaces), or a list with one action for each result.
            extras: further columns of n rows (``log_prob``, ``value``, …).

        Raises:
            BadAction: the number of rows of a column is not the number of results, or one is called
                ``env_id``. Hardware of the batch stops.
        """
        columns = {"action": action, **extras}
        origin = self._origin
        count = len(self) if origin is None else len(origin.slots)
        try:
            if "env_id" in extras:  # Every response has one.
                raise BadAction("no column can be called 'env_id'; give it another name")
            for name, column in columns.items():
                if type(column) is not np.ndarray or not column.ndim or len(column) != count:
                    mapped(lambda leaf, name=name: _check_rows(name, leaf, len(self)), column)
        except BadAction:
            if origin is not None and origin.issuer is not None:
                origin.issuer.stop_hardware(origin.slots.tolist())
            raise
        return _responses(self, columns)

    @property
    def action(self) -> Any:
        """Actions of a batch of responses: ``[n, *action]``, or dicts, tuples, lists of such.

        Raises:
            AttributeError: the batch holds results; see `sent` for their actions.
        """
        if self._columns is not None:
            return self._columns["action"]
        return stacked_values([value.action for value in self.values()])


def parts_of(batch: BatchedData) -> Sequence[ResultColumns]:
    """The columns of a batch of results; empty for any other batch."""
    return batch._parts


def origin_of(batch: BatchedData) -> Origin | None:
    """Group and slots of a batch; None for plain values."""
    return batch._origin


def sources_of(batch: BatchedData) -> Sources | None:
    """Requests that the results of `batch` answer; None for any other batch."""
    return batch._sources


def columns_of_responses(batch: BatchedData) -> Mapping[str, Any] | None:
    """Columns of a batch made by `BatchedData.respond`; None for any other batch."""
    return batch._columns


def plain_columns(batch: BatchedData) -> ResultColumns | None:
    """The columns of a batch whose properties of the same names equal them; None for others."""
    parts = batch._parts
    if len(parts) != 1:
        return None
    part = parts[0]
    unlike = part.positions is not None or part.agents
    return None if unlike or part.observation is None or not len(part.slots) else part


def has_ended(batch: BatchedData) -> NDArray[np.bool_]:
    """Mask of rows whose episode has ended and was not reset since; shaped like `is_reset`."""
    parts = batch._parts
    if not parts:
        return np.zeros(0, np.bool_)
    return (
        parts[0].has_ended if len(parts) == 1 else column_of_parts(parts, attrgetter("has_ended"))
    )


def slots_of(batch: BatchedData, issuer: object) -> NDArray[np.intp] | None:
    """Slots of the envs, each once, if the batch is from the group of `issuer`."""
    origin = batch._origin
    if origin is None or origin.issuer is not issuer or origin.repeats:
        return None
    return origin.slots


def _entry_of(env_id: str) -> str:
    """Return the name of the entry in the id of an env or a client."""
    found = _ID_IN_ENTRY.search(env_id)
    return env_id[: found.start()] if found else env_id.rpartition("-")[0] or env_id


def batch_of_results(
    parts: Sequence[ResultColumns],
    issuer: Issuer | None,
    slots: NDArray[np.intp],
    names: EnvNames,
    sources: Sources | None = None,
) -> BatchedData:
    """Make a batch of results from columns.

    Args:
        parts: one for each layout, with the positions of its rows unless it is the only one.
        issuer: of the group that returns the batch; see `Origin`.
        slots: slot of each row.
        names: of the envs of the group.
        sources: see `Sent`.
    """
    batch = BatchedData.__new__(BatchedData)
    batch._ids = batch._values = batch._columns = batch._env_ids = batch._infos = None
    batch._parts = parts
    batch._origin = Origin(issuer, slots, names)
    batch._sources = sources
    return batch


def with_repeats(batch: BatchedData) -> BatchedData:
    """Record in `batch` itself whether it has an env twice, and return it."""
    origin = batch._origin
    if origin is not None:
        origin.repeats = len({*origin.slots.tolist()}) < len(origin.slots)
    return batch


def answer_of(batch: BatchedData, issuer: object) -> tuple[NDArray[np.intp], dict[str, Any]] | None:
    """Distinct slots, and columns of responses, to results of `issuer`; None for other batches."""
    if type(batch) is not BatchedData or batch._columns is None:
        return None
    origin = batch._origin
    if origin is None or origin.issuer is not issuer or origin.repeats:
        return None
    return origin.slots, batch._columns


def _head(batch: BatchedData, column: str, attribute: str) -> Any:
    """A column of rewards or flags, by agent if there are agents."""
    if len(batch._parts) == 1:
        part = batch._parts[0]
        return part.stacked_head(column) if part.agents else getattr(part, column)
    if not len(batch):
        return np.empty(0, np.float64 if column == "reward" else np.bool_)
    return stacked_values([getattr(value, attribute) for value in batch.values()])


def _by_row(batch: BatchedData, column: Callable[[ResultColumns], Any]) -> NDArray[Any]:
    """A column of all parts, in the order of the batch."""
    parts = batch._parts
    if len(parts) == 1 and parts[0].positions is None and len(parts[0].slots):
        return column(parts[0])
    if batch._origin is not None and batch._columns is None and not len(batch):
        return np.zeros(0, np.bool_)
    if not parts:
        raise AttributeError("only results of a group have this; this batch holds plain values")
    return column_of_parts(parts, column)


def _responses(batch: BatchedData, columns: dict[str, Any]) -> BatchedData:
    responses = BatchedData.__new__(BatchedData)
    responses._ids = batch._ids
    responses._columns = columns
    responses._origin = batch._origin
    responses._env_ids = None if batch._origin is not None else batch.env_ids()
    responses._values = responses._sources = responses._infos = None
    responses._parts = ()
    return responses


def _policy_responses(columns: dict[str, Any], env_ids: list[str]) -> list[PolicyResponse]:
    return [
        PolicyResponse(env_id, **{name: index(c, k) for name, c in columns.items()})
        for k, env_id in enumerate(env_ids)
    ]


def _taken_responses(batch: BatchedData, columns: dict[str, Any], chosen: list[int]) -> BatchedData:
    def taken(leaf: Any) -> Any:
        return leaf[chosen] if hasattr(leaf, "shape") else [leaf[k] for k in chosen]

    found = _responses(batch, {name: mapped(taken, column) for name, column in columns.items()})
    origin = batch._origin
    if origin is None:
        env_ids = batch.env_ids()
        found._env_ids = [env_ids[k] for k in chosen]
    else:
        found._origin = Origin(origin.issuer, origin.slots[chosen], origin.names)
    found._ids = [batch.ids()[k] for k in chosen]
    return with_repeats(found)


def _check_rows(name: str, column: Any, count: int) -> None:
    try:
        rows = len(column)
    except TypeError:
        rows = None
    if rows != count:
        found = f"is {column!r}" if rows is None else f"has {rows} rows"
        raise BadAction(
            f"column {name!r} {found} for a batch of {count}; give one row for "
            "each result, in the batch's order: an array, or a list of plain values"
        )
