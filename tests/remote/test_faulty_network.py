"""Through a proxy that disturbs connections: executed once, answered once."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from kit.counting import ClientThread
from patience import HANG
from remote.faulty_proxy import Faults, FaultyProxy
from remote.recording import HEARTBEAT, RecordingEnv

from rlightning_aio import BatchedData, PolicyResponse, sync

if TYPE_CHECKING:
    from collections.abc import Callable

REQUESTS = int(os.environ.get("RLIGHTNING_AIO_FAULTY_REQUESTS", "400"))
"""For each kind of network; 10,000 take some minutes."""
CLIENTS = 3


NETWORKS = {
    "breaking": Faults(cut=0.02),
    "falling silent": Faults(silence=0.006),
    "both": Faults(cut=0.01, silence=0.008),
}


def make_config(num_clients: int) -> dict[str, Any]:
    return {
        "name": "robots",
        "backend": "env_server",
        "max_restarts": 1_000_000,
        "env_kwargs": {
            "clients": [f"c{k}" for k in range(num_clients)],
            "heartbeat": HEARTBEAT,
            "connect_timeout": HANG,
        },
    }


def check(ends: dict[str, int], folder: Path, proxy: FaultyProxy, faults: Faults) -> None:
    """Compare what the trainer has got with what the clients have done."""
    executed = [int(number) for file in folder.iterdir() for number in file.read_text().split()]
    assert len(executed) == len(set(executed)), "a request was executed twice"
    assert ends["answered"] <= len(executed) <= sum(ends.values())
    fates = [name for name in ("cut", "silence") if getattr(faults, name)]
    assert all(proxy.tally[name] for name in fates), "the network had too few faults"


@pytest.mark.timeout(600)
@pytest.mark.parametrize("network", NETWORKS)
def test_no_request_is_executed_twice_and_each_ends_once(
    network: str, tmp_path: Path, record_property: Callable[[str, Any], None]
) -> None:
    """Every request of the trainer ends in its own result, or in a marked one."""
    envs = [RecordingEnv(k, tmp_path / f"c{k}") for k in range(CLIENTS)]
    with (
        sync.build_env_group(make_config(CLIENTS)) as group,
        FaultyProxy(group["robots-0"].address, NETWORKS[network], seed=1) as proxy,
    ):
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
    check(ends, tmp_path, proxy, NETWORKS[network])


@pytest.mark.timeout(1500)
def test_a_fleet_of_which_robots_are_killed_and_stopped(tmp_path: Path) -> None:
    """Four of them; twenty, for some minutes, with RLIGHTNING_AIO_FLEET=20,200000 and -s."""
    count, requests = map(int, os.environ.get("RLIGHTNING_AIO_FLEET", "4,800").split(","))
    faults, began = Faults(cut=0.004, silence=0.002), time.monotonic()
    program = [sys.executable, "-m", "remote.unlucky_clients"]
    with (
        sync.build_env_group(make_config(count)) as group,
        FaultyProxy(group["robots-0"].address, faults, seed=1) as proxy,
    ):
        clients = subprocess.Popen(
            [*program, proxy.address, str(count), str(tmp_path), "1"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent.parent,
        )
        try:
            ends = exchange(group, requests)
        finally:
            unlucky, _ = clients.communicate("")
    sys.stdout.write(
        f"{time.monotonic() - began:.0f} s, {count} clients: {ends}; the network: {proxy.tally}; "
        f"clients: {unlucky}\n"
    )
    assert clients.returncode == 0
    check(ends, tmp_path, proxy, faults)


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
