"""`Results`: ready rows become a batch, with a few copies for each slab and none for each env."""

from __future__ import annotations

import pickle
from collections import defaultdict
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio._core.group.state.conditions import BESIDE_ROWS
from rlightning_aio._core.group.state.slab_layout import rows_in
from rlightning_aio.batch.columns import ResultColumns
from rlightning_aio.batch.sent import UNASKED, copied
from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.columns import Rows, gather
from rlightning_aio.protocol.info import NO_INFO, PICKLED
from rlightning_aio.protocol.slab import TRUNCATED
from rlightning_aio.trees import holds_tensor, index, mapped, stacked

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.episodes import Report
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.messages import OutOfBand
    from rlightning_aio.batch.sent import Sources
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.protocol.slab import Slab
    from rlightning_aio.trees import Tree

_Chosen: TypeAlias = "tuple[Slab, NDArray[np.intp], NDArray[np.intp] | None]"
"""A slab, slots whose rows it has, and their positions in a batch; None for 0, 1, 2, …"""


class Results:
    """What lies in the rows of a group, and what came out of band.

    Args:
        tables: of the group.
        zero_copy: observations are handed out as views where their rows are contiguous.
    """

    def __init__(self, tables: Tables, *, zero_copy: bool) -> None:
        self._envs = envs = tables.envs
        self._conditions = tables.conditions
        self._layout = tables.layout
        self._zero_copy = zero_copy
        self._out_of_band: dict[int, Any] = {}
        # Of each slot's host; a host's slots share one dict.
        self._schemas: list[dict[int, InfoSchema]] = [{} for _ in range(len(envs))]
        self._schemas_of = defaultdict[int, dict[int, "InfoSchema"]](dict)
        # Bytes of a row's info that any schema uses; 0 if there is none.
        self._info_width = 0
        self._restarted = np.zeros(len(envs), np.bool_)
        self._any_restarted = False
        # What was sent, by slot; that of the last batch is entered when that is needed.
        self._sent_columns = np.full(len(envs), None, object)
        self._sent_rows = np.zeros(len(envs), np.intp)
        self._last_sent: tuple[NDArray[np.intp], Mapping[str, Any]] | None = None
        # The columns sent last to each entry: examples for rows that answer no response. Batches
        # refer to these dicts, so they are replaced and never changed.
        self._examples: list[dict[str, Any]] = [{} for _ in envs.names.entry_names]
        self._any_unasked = False
        self._each = np.arange(len(envs))

    # -- what comes in ----------------------------------------------------------------

    def note_sent(self, slots: NDArray[np.intp], columns: Mapping[str, Any]) -> None:
        """Keep the columns that a policy sent to `slots`, one row for each, for their results."""
        if self._last_sent is not None and self._last_sent[0] is not slots:
            self._enter_last_sent()  # Else all of it is replaced.
        kept: dict[str, Any] = {}
        for name, column in columns.items():  # Their maker may still write to them.
            kept[name] = column.copy() if type(column) is np.ndarray else copied(column)
        self._last_sent = slots, kept
        entries = {0}
        if len(self._examples) > 1:
            entries = set(cast("list[int]", self._envs.names.entries[slots].tolist()))
        for k in entries:
            self._examples[k] = dict(kept)

    def note_unasked(self, slots: NDArray[np.intp]) -> None:
        """Note that the next results of `slots` answer no response."""
        self._enter_last_sent()
        self._sent_rows[slots] = UNASKED
        self._any_unasked = True

    def _enter_last_sent(self) -> None:
        if self._last_sent is not None:
            slots, columns = self._last_sent
            self._last_sent = None
            self._sent_columns[slots] = columns
            self._sent_rows[slots] = self._each[: len(slots)]

    def keep(self, slot: int, out_of_band: bytes | OutOfBand) -> None:
        """Keep what of a result has no place in its row."""
        if out_of_band:
            self._out_of_band[slot] = out_of_band
            self._conditions.note(BESIDE_ROWS, True)

    def begin_schemas(self, host_id: int, slots: Sequence[int]) -> None:
        """Forget the schemas of a host, of `slots`: its new worker announces its own."""
        self._schemas_of[host_id] = {}
        self.use_schemas(host_id, slots)

    def use_schemas(self, host_id: int, slots: Sequence[int]) -> None:
        """Decode infos of `slots` by the schemas of a host from now on."""
        # A new list: batches that were handed out still read the old one.
        self._schemas = list(self._schemas)
        for slot in slots:
            self._schemas[slot] = self._schemas_of[host_id]

    def note_schema(self, host_id: int, number: int, schema: InfoSchema) -> None:
        """Note a schema of infos that a host has announced."""
        self._schemas_of[host_id][number] = schema
        self._info_width = max(self._info_width, schema.size, 1)

    def mark_restarted(self, report: Report) -> None:
        """Mark a result as the first of a replaced worker, and note in its info what it reports."""
        self.detach_info(report.slot)
        found = self._out_of_band.get(report.slot)
        if isinstance(found, dict):
            info, why = cast("dict[str, Any]", found["info"]), report.why
            is_place = report.slot >= self._envs.num_local
            info["client_lost" if is_place else "worker_restarted"] = why.cause
            if why.at_fault is not None:
                info["env_at_fault"] = why.at_fault
            info["outcome"] = why.outcome(self._envs.env_ids[report.slot])
        self._mark(report.slot)

    def _mark(self, slot: int) -> None:
        self._restarted[slot] = self._any_restarted = True
        self._conditions.note(BESIDE_ROWS, True)

    def detach_info(self, slot: int) -> None:
        """Decode the info of a result that is ready, while its row and schemas are there."""
        slab, row = self._layout.of(slot)
        found = self._out_of_band.get(slot)
        try:
            kept: dict[str, Any] = pickle.loads(found) if isinstance(found, bytes) else found or {}
        except Exception:  # noqa: BLE001  # It may hold anything; its reader learns why not.
            return
        info: dict[str, Any] = kept.get("info", {})
        mark = int(slab.info_mark[row])  # Left as it is: the env's snapshot reads the row, too.
        if "info" not in kept and mark not in (NO_INFO, PICKLED):
            info = self._schemas[slot][mark].decode(memoryview(slab.info[row]))
        self._out_of_band[slot] = {**kept, "info": dict(info)}
        self._conditions.note(BESIDE_ROWS, True)

    # -- what goes out ----------------------------------------------------------------

    def gather(self, slots: NDArray[np.intp]) -> list[ResultColumns]:
        """Copy the results of `slots` out of their rows: one part for each layout."""
        layout, width, restarted = self._layout, self._info_width, None
        in_first = len(layout.slabs) == 1
        if not in_first and layout.num_in_first and len(slots):  # Of clients are the others.
            in_first = slots is self._envs.local or int(slots.max()) < layout.num_in_first
        if in_first:
            chosen: list[_Chosen] = [(layout.slabs[0], slots, None)]
        else:
            chosen = self._by_slab(slots)
        parts: list[ResultColumns] = []
        for slab, own, positions in chosen:
            if own is self._envs.local and layout.num_in_first:
                rows: Rows = slice(0, len(own))
            else:
                rows = own if layout.row_is_slot else layout.row[own]
            columns = [slab.reward, slab.flags, slab.times]
            if width:
                columns += (slab.info_mark, slab.info[:, :width])
            observation: Any = slab.observation
            in_rows = type(observation) is np.ndarray and not self._zero_copy
            if in_rows:
                columns.append(observation)
            reward, flags, times, *others = kernel.gather(columns, rows)
            marks, info = others[:2] if width else (None, None)
            if self._any_restarted:
                restarted = self._restarted[own]
                # Here and not in the row, where envs write their flags only when they change.
                flags[restarted, ..., TRUNCATED] = True
            observation = others[-1] if in_rows else self._observations(slab, rows)
            out_of_band: dict[int, Any] = {}
            if self._out_of_band:
                out_of_band = self._out_of_band_of(own, marks)
                observation = _handed_over(slab, observation, out_of_band, len(own))
            parts.append(
                ResultColumns(
                    slots=own,
                    names=self._envs.names,
                    positions=positions,
                    observation=observation,
                    reward=reward,
                    flags=flags,
                    info_marks=marks,
                    info=info,
                    schemas=self._schemas,
                    out_of_band=out_of_band,
                    restarted=restarted,
                    times=times,
                    sent_ns=None if slab.sent_ns is None else gather(slab.sent_ns, rows),
                    agents=slab.layout.agents,
                    observation_space=slab.layout.observation_space,
                )
            )
        return parts

    def _by_slab(self, slots: NDArray[np.intp]) -> list[_Chosen]:
        """Return each slab with its part of `slots`, and with their positions there."""
        slabs = self._layout.slab[slots]
        present: list[int] = np.flatnonzero(np.bincount(slabs)).tolist()
        each = [(slab, np.flatnonzero(slabs == slab)) for slab in present]
        return [(self._layout.slabs[slab], slots[places], places) for slab, places in each]

    def add_episodes(self, part: ResultColumns) -> None:
        """Copy the sums of the episodes that end in `part`; its rows are as they were."""
        slots, layout = part.slots, self._layout
        slab = layout.slabs[layout.slab.item(slots.item(0))]
        rows = rows_in(layout, slots, self._envs.local)
        part.episode_return, part.episode_length = kernel.gather(
            (slab.episode_return, slab.episode_length), rows
        )

    def drop(self, slots: NDArray[np.intp]) -> None:
        """The results of `slots` are handed out: what is kept for them beside their rows goes."""
        if self._any_restarted:
            self._restarted[slots] = False
            self._any_restarted = bool(self._restarted.any())
        if self._out_of_band:
            for slot in slots.tolist():
                self._out_of_band.pop(slot, None)
        self._conditions.note(BESIDE_ROWS, self._any_restarted or bool(self._out_of_band))

    def sources(self, slots: NDArray[np.intp]) -> Sources:
        """Return the columns that were sent for the results of `slots`."""
        if self._last_sent is not None and self._last_sent[0] is slots:
            return self._last_sent[1], None  # As `step` asks and is answered.
        self._enter_last_sent()
        columns, rows = self._sent_columns[slots], self._sent_rows[slots]
        if self._any_unasked:
            for k in np.flatnonzero(rows == UNASKED).tolist():
                columns[k] = self._example_for(slots.item(k))
            self._any_unasked = bool((self._sent_rows == UNASKED).any())
        return columns, rows

    def _example_for(self, slot: int) -> dict[str, Any]:
        """Return the columns sent last to the entry of `slot`, or an action without rows."""
        entry = self._envs.names.entries.item(slot)
        if not self._examples[entry]:
            action = self._layout.of(slot)[0].action
            if action is not None:
                self._examples[entry] = {"action": mapped(_without_rows, action)}
        return self._examples[entry]

    def _out_of_band_of(
        self, slots: NDArray[np.intp], info_marks: NDArray[np.uint8] | None
    ) -> dict[int, Any]:
        """Return out-of-band data of `slots` by batch row.

        Mark the infos among it in `info_marks`, gathered from rows that may still mark their own.
        """
        found: dict[int, Any] = {}
        for row, slot in enumerate(slots.tolist()):
            kept = self._out_of_band.get(slot)
            if kept is None:
                continue
            found[row] = kept
            if type(kept) is dict and info_marks is not None and "info" in kept:
                info_marks[row] = PICKLED
        return found

    def _observations(self, slab: Slab, rows: Rows) -> Any:
        """Fresh columns, or read-only views where the group has those and the rows allow it."""
        if slab.observation is None:
            return None
        contiguous = _contiguous(rows) if self._zero_copy else None
        if contiguous is None:
            return gather(slab.observation, rows)

        def view(array: NDArray[Any]) -> NDArray[Any]:
            part = array[contiguous]
            part.flags.writeable = False
            return part

        return mapped(view, slab.observation)


def _handed_over(
    slab: Slab, observation: Any, out_of_band: dict[int, Any], count: int
) -> Tree | None:
    """Return the column of the observations of `count` rows, some of which may be out of band.

    None if `out_of_band` has all of them, where tensors stay on their device. What envs hand over
    as fresh arrays becomes a column; that of one alone isn't copied.
    """
    kept: dict[int, dict[str, Any]] = {
        row: one for row, one in out_of_band.items() if type(one) is dict
    }
    beside = {row: one["observation"] for row, one in kept.items() if "observation" in one}
    if not beside:
        return observation
    if slab.layout.observations_out_of_band and not any(map(holds_tensor, beside.values())):
        for row in beside:
            out_of_band[row] = {k: v for k, v in kept[row].items() if k != "observation"}
        return stacked([*beside.values()])
    if observation is not None and len(beside) < count:  # Some have returned arrays.
        for row in set(range(count)) - beside.keys():
            found = out_of_band.get(row, {})
            own = pickle.loads(found) if isinstance(found, bytes) else found
            out_of_band[row] = {**own, "observation": index(observation, row)}
    return None


def _without_rows(column: NDArray[Any]) -> NDArray[Any]:
    """An empty array with the dtype and the shape of a row of `column`."""
    return np.empty((0, *column.shape[1:]), column.dtype)


def _contiguous(rows: Rows) -> slice | None:
    if isinstance(rows, slice):
        return rows
    if not len(rows):
        return None
    first, last = int(rows[0]), int(rows[-1])
    if last - first + 1 == len(rows) and (np.diff(rows) == 1).all():
        return slice(first, last + 1)
    return None
