"""`rets_of`: the results of a batch as separate values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.batch.infos import info_list_of_rows
from rlightning_aio.trees import zipped
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, unchecked

if TYPE_CHECKING:
    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["rets_of"]

_FIELDS: Final = (
    "env_id",
    "observation",
    "last_reward",
    "last_terminated",
    "last_truncated",
    "info",
    "ts_env_sent_ns",
)
"""Of a result; see `EnvRet`."""


def rets_of(part: ResultColumns) -> list[EnvRet | MultiAgentEnvRet]:
    """Results of all envs as separate values."""
    rows = range(len(part.slots))
    if part.out_of_band or part.reward.ndim > 1:
        return [_ret(part, row) for row in rows]
    # As `_ret`, column by column, which takes half of the time.
    terminated, truncated = part.terminated.tolist(), part.truncated.tolist()
    infos = info_list_of_rows(part)
    for row in np.flatnonzero(part.done).tolist():
        infos[row] = part.info_of(row)
    env_ids, reward = part.names.ids(part.slots), part.reward.tolist()
    observation = [part.observation_of(row) for row in rows]
    times = [part.sent_ns_of(row) for row in rows]
    columns = env_ids, observation, reward, terminated, truncated, infos, times
    return [
        unchecked(EnvRet, dict(zip(_FIELDS, fields, strict=True)))
        for fields in zip(*columns, strict=True)
    ]


def _ret(part: ResultColumns, row: int) -> EnvRet | MultiAgentEnvRet:
    kept = part.out_of_band_of(row)
    if "ret" in kept:
        return _ret_handed_over(part, row, kept["ret"])
    fields = (
        part.names.env_ids[part.slots.item(row)],
        part.observation_of(row),
        part.head_of(part.reward, row),
        part.head_of(part.terminated, row),
        part.head_of(part.truncated, row),
        part.info_of(row),
        part.sent_ns_of(row),
    )
    kind = MultiAgentEnvRet if part.agents else EnvRet
    return unchecked(kind, dict(zip(_FIELDS, fields, strict=True)), kept.get("extra"))


def _ret_handed_over(part: ResultColumns, row: int, ret: Any) -> Any:
    changed: dict[str, Any] = {}
    for name in ("reward", "terminated", "truncated"):
        field = f"last_{name}"
        if _is_default(getattr(ret, field)) and part.reward.ndim > 1:
            changed[field] = part.head_of(getattr(part, name), row)
    if part.episode(row):
        changed["info"] = part.info_of(row)
    if part.limit_reached is not None and part.limit_reached[row]:
        changed["last_truncated"] = zipped(
            _like, ret.last_truncated, part.head_of(part.truncated, row)
        )
    return ret.model_copy(update=changed) if changed else ret


def _is_default(field: Any) -> bool:
    """Return True if a reward or flag of all sub-environments or agents was left out."""
    return type(field) in (float, bool) or (isinstance(field, dict) and not field)


def _like(old: Any, value: Any) -> Any:
    """Convert `value` to the type of `old`: a tensor on the same device, or an array."""
    return old.new_tensor(value) if hasattr(old, "new_tensor") else value
