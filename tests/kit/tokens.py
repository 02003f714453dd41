"""Entries of `faulty` envs, and checks of their results against the requests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from kit.faulty import CODES

import rlightning_aio

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvRet


def entry(num_workers: int = 2, **fields: Any) -> dict[str, Any]:
    """Return a config entry of faulty envs, which share one worker unless `fields` say
    otherwise.
    """
    return {
        "name": "faulty",
        "backend": "faulty",
        "task": "anything",
        "num_workers": num_workers,
        **({} if fields.get("placement") == "inline" else {"envs_per_process": num_workers}),
        **fields,
    }


def two_workers(**fields: Any) -> dict[str, Any]:
    """Return an entry of four envs, two in each worker."""
    return entry(4, **{"envs_per_process": 2, **fields})


class Tokens:
    """Makes steps with a new token for each env, and checks results against them."""

    def __init__(self) -> None:
        self._next = 1.0
        self._asked: dict[str, float] = {}

    def steps(self, env_ids: list[str], faults: dict[str, str] | None = None) -> BatchedData:
        """Return a batch of steps; `faults` is by env id."""
        actions: list[np.ndarray] = []
        for env_id in env_ids:
            self._asked[env_id] = self._next
            fault = (faults or {}).get(env_id, "nothing")
            actions.append(np.array([CODES[fault], self._next]))
            self._next += 1
        responses = [
            rlightning_aio.PolicyResponse(env_id, action)
            for env_id, action in zip(env_ids, actions, strict=True)
        ]
        return rlightning_aio.BatchedData(env_ids, responses)

    def check(self, batch: BatchedData) -> None:
        """Check that every result of `batch` answers its own env's last step."""
        for env_id, ret in batch.items():
            index, _, _, steps, token = ret.observation
            assert env_id == ret.env_id
            assert env_id == f"faulty-{int(index)}"
            assert token == self._asked[env_id]
            assert ret.last_reward == token
            assert ret.info == {"steps": steps, "name": index}


def marked(ret: EnvRet) -> bool:
    """Return True if a result comes from a replacement; check that it is as it must be then."""
    if "worker_restarted" not in ret.info:
        return False
    assert ret.last_truncated
    assert not ret.last_terminated
    assert ret.last_reward == 0.0
    assert list(ret.observation[2:]) == [1, 0, 0], (
        "a marked result has the first reset of a new life"
    )
    assert ret.info["resets"] == 1
    return True
