"""`Shown`: the last result of an env, taken out of its row, and shown there once more.

Rule: shown again, a result is no transition: no reward, no end, `is_reset`. Observation, info
and the sums of the episodes under way are what they were, so that an env that was put back goes
on as it would have. With the env's state it is one pickle, the *standing* of the env.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rlightning_aio.hosts.pickling import dumped
from rlightning_aio.protocol.columns import row_reader
from rlightning_aio.protocol.info import PICKLED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.hosts.messages import OutOfBand
    from rlightning_aio.hosts.row_writer import RowWriter
    from rlightning_aio.protocol.slab import Slab

__all__ = ["Shown", "packed_standing", "show", "shown_in", "standing_of"]


@dataclass(frozen=True)
class Shown:
    """See the module.

    Attributes:
        observation, info: of the result.
        whole: the result itself, where it was handed over as it is.
        returns, lengths, over: of the episodes under way, in the shape of the row's.
    """

    observation: Any
    info: dict[str, Any]
    whole: Any
    returns: NDArray[Any]
    lengths: NDArray[Any]
    over: NDArray[Any]


def shown_in(slab: Slab, row: int, writer: RowWriter, whole: Any) -> Shown:
    """A copy of what `row` shows, and of what was out of band beside it."""
    mark = int(slab.info_mark[row])
    beside: OutOfBand = writer.out_of_band
    info = beside.get("info", {}) if mark == PICKLED else writer.read_info(mark)
    observation = None
    if slab.observation is None:
        observation = beside.get("observation")
    elif whole is None:
        observation = row_reader(slab.layout.observation_space, slab.observation, row)()
    sums = (slab.episode_return, slab.episode_length, slab.over)
    returns, lengths, over = (column[row, ...].copy() for column in sums)
    return Shown(observation, info, whole, returns, lengths, over)


def show(shown: Shown, slab: Slab, row: int, writer: RowWriter, done_ns: int) -> OutOfBand | None:
    """Write it into the row; what of it is out of band."""
    slab.reward[row, ...] = 0.0
    slab.flags[row, ...] = False
    slab.is_reset[row, ...] = True
    slab.over[row, ...] = shown.over
    slab.episode_return[row, ...] = shown.returns
    slab.episode_length[row, ...] = shown.lengths
    writer.look()
    writer.write_times(done_ns, 0)
    if shown.whole is not None:
        return {"ret": shown.whole}
    return writer.write_data(shown.observation, shown.info)


def packed_standing(state: Any, shown: Shown | None) -> bytes:
    """An env's state with what it shows; None where it has shown nothing yet.

    Raises:
        TypeError: the state can't be pickled.
    """
    return dumped((state, shown), "its state")


def standing_of(packed: bytes) -> tuple[Any, Shown | None]:
    """What `packed_standing` has packed, in a process of the same user."""
    return pickle.loads(packed)
