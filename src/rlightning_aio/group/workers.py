"""What the hosts of a group are doing now, for whoever watches it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.group.host_record import Stage

if TYPE_CHECKING:
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.host_record import HostRecord
    from rlightning_aio.group.requests import Requests

__all__ = ["describe"]

_STATES: Final = {
    Stage.NEW: "new",
    Stage.UP: "up",
    Stage.DOWN: "down",
    Stage.FAILED: "failed",
    Stage.CLOSED: "closed",
}


def describe(record: HostRecord, envs: EnvTable, requests: Requests, now_ns: int) -> dict[str, Any]:
    """See `EnvGroup.get_workers`. `now_ns` is of the monotonic clock."""
    slots = np.array(record.slots, np.intp)
    owed = requests.owed(slots)
    owed = owed[np.argsort(requests.sent_ns[owed], kind="stable")]
    return {
        "entry": record.config.name,
        "env_ids": [env_id for slot in slots if (env_id := envs.env_ids[slot])],
        "pid": getattr(record.host, "pid", None),
        "state": _STATES.get(record.stage, "starting"),
        "owed": [envs.env_ids[slot] for slot in owed],
        "owed_seconds": (now_ns - int(requests.sent_ns[owed[0]])) / 1e9 if len(owed) else 0.0,
        "restarts": record.restarts,
    }
