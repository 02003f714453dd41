"""Through a proxy that disturbs connections: executed once, answered once."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from kit.counting import ClientThread, CountingEnv
from patience import HANG
from remote.faulty_proxy import Faults, FaultyProxy

from rlightning_aio import BatchedData, PolicyResponse, sync

if TYPE_CHECKING:
    from collections.abc import Callable

REQUESTS = int(os.environ.get("RLIGHTNING_AIO_FAULTY_REQUESTS", "400"))
"""For each kind of network; 10,000 take some minutes."""
HEARTBEAT = 0.8
CLIENTS = 3


class RecordingEnv(CountingEnv):
    """Its observation is (identity, the request's number, steps since the reset).

    The action's first element is the request's number.
    """

    def __init__(self, identity: int) -> None:
        super().__init__(identity)
        self.executed: list[int] = []
        self.number = -1

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        self.number = -1
        return super().reset(seed=seed, options=options)

    def step(self, policy_resp: PolicyResponse) -> Any:
        self.number = int(policy_resp.action[0] * 2**20)
        self.executed.append(self.number)
        return super().step(policy_resp)

    def ret(self) -> Any:
        ret = super().ret()
        ret.observation[1] = self.number
        return ret


NETWORKS = {
    "breaking": Faults(cut=0.02),
    "falling silent": Faults(silence=0.006),
    "both": Faults(cut=0.01, silence=0.008),
}


@pytest.mark.timeout(600)
@pytest.mark.parametrize("network", NETWORKS)
def test_no_request_is_executed_twice_and_each_ends_once(
    network: str, record_property: Callable[[str, Any], None]
) -> None:
    """Every request of the trainer ends in its own result, or in a marked one."""
    envs = [RecordingEnv(k) for k in range(CLIENTS)]
    config = {
        "name": "robots",
        "backend": "env_server",
        "max_restarts": 1_000_000,
        "env_kwargs": {
            "clients": [f"c{k}" for k in range(CLIENTS)],
            "heartbeat": HEARTBEAT,
            "connect_timeout": HANG,
        },
    }
    with sync.build_env_group(config) as group:
        with FaultyProxy(group["robots-0"].address, NETWORKS[network], seed=1) as proxy:
            threads = [ClientThread(proxy.address, f"c{k}", env) for k, env in enumerate(envs)]
            for env in envs:
                env.stays = True
            ends = exchange(group, REQUESTS)
            for env in envs:
                env.stays, env.finished = False, True
            group.close()
            for thread in threads:
                thread.join()
        record_property("network", proxy.tally)
        record_property("requests", ends)
    executed = [number for env in envs for number in env.executed]
    assert len(executed) == len(set(executed)), "a request was executed twice"
    assert sum(ends.values()) == REQUESTS
    assert ends["answered"] <= len(executed) <= REQUESTS
    fates = [name for name in ("cut", "silence") if getattr(NETWORKS[network], name)]
    assert all(proxy.tally[name] for name in fates), "the network had too few faults"


def exchange(group: Any, requests: int) -> dict[str, int]:
    """Step clients that have answered until `requests` have ended; count how they ended."""
    ends = {"answered": 0, "marked": 0}
    asked: dict[str, int] = {}
    sent = 0
    batch, _ = group.reset()
    while True:
        for ret, action in zip(batch.values(), batch.sent.action, strict=True):
            number = asked.pop(ret.env_id, None)
            if number is None:
                assert np.isnan(action).all(), "a result that answers nothing"
            else:
                assert action[0] == number / 2**20, "the answer to another request"
            if "client_lost" in ret.info:
                assert ret.last_truncated
                assert number is not None, "a loss without a request"
                ends["marked"] += 1
            elif number is not None:
                assert ret.observation[1] == number, "the result of another request"
                assert ret.env_id == f"robots-0/c{int(ret.observation[0])}"
                ends["answered"] += 1
        if sum(ends.values()) == requests:
            return ends
        responses = []
        for env_id in dict.fromkeys(batch.env_ids()):
            if sent < requests:
                asked[env_id] = sent
                action = np.array([sent / 2**20, 0], np.float32)
                responses.append(PolicyResponse(env_id, action))
                sent += 1
        if responses:
            group.step_async(BatchedData([one.env_id for one in responses], responses))
        batch, _ = group.collect_async(deadline=HANG)
