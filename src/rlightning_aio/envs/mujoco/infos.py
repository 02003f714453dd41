"""Infos of several simulations in Gymnasium's form: columns with masks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.envs.mujoco.task import Columns

Infos = dict[str, Any]


class Begun(NamedTuple):
    """Simulations that were reset: their ids, and their infos."""

    ids: NDArray[np.intp]
    columns: Columns

    def added(self, infos: Infos, count: int) -> Infos:
        """Add their infos to those of all `count` simulations."""
        ids = self.ids
        for name, values in self.columns().items():
            mask = infos.setdefault("_" + name, np.zeros(count, np.bool_))
            column = infos.setdefault(name, np.zeros((count, *values.shape[1:]), values.dtype))
            column[ids], mask[ids] = values, True
        return infos


class Finished(NamedTuple):
    """Simulations that have ended and were reset in the same step: a mask, last observations."""

    mask: NDArray[np.bool_]
    last: NDArray[Any]


def of_step(
    columns: Columns,
    count: int,
    failures: dict[int, Infos],
    begun: Begun | None,
    ended: Finished | None,
    add_info: Any,
) -> Infos:
    """Infos of a step.

    Args:
        columns: of all simulations.
        count: the number of simulations.
        failures: infos of simulations that have failed.
        begun: simulations that were reset: instead of a step, or with `ended`, after it.
        ended: those that ended and were reset in this step.
        add_info: Gymnasium's function for one simulation.
    """
    instead = begun if ended is None else None
    apart = list(failures)
    if instead is not None:
        apart += instead.ids.tolist()
    infos, stepped = dict[str, Any](), np.ones(count, np.bool_)
    stepped[apart] = False
    if len(apart) < count:
        for name, column in columns().items():
            infos[name], infos["_" + name] = column, stepped
            if apart:
                infos[name], infos["_" + name] = column.copy(), stepped.copy()
                infos[name][apart] = 0
    for k, info in failures.items():
        infos = add_info(infos, info, k)
    if instead is not None:
        infos = instead.added(infos, count)
    if ended is None or begun is None:
        return infos
    final = np.full(count, None, object)
    for k, row in zip(begun.ids.tolist(), ended.last, strict=True):
        final[k] = row
    mask = ended.mask
    infos, final_info = _only(infos, ~mask), _only(infos, mask)
    infos = begun.added(infos, count)
    infos.update(final_obs=final, _final_obs=mask.copy())
    infos.update(final_info=final_info, _final_info=mask.copy())
    return infos


def _only(infos: Infos, chosen: NDArray[np.bool_]) -> Infos:
    """Copy what the columns have for the simulations `chosen`, with masks as in Gymnasium."""
    found: Infos = {}
    for name, column in infos.items():
        if name.startswith("_"):
            continue
        mask = infos["_" + name] & chosen
        if mask.any():
            found[name] = column.copy()
            found[name][~mask] = None if column.dtype == object else 0
            found["_" + name] = mask
    return found
