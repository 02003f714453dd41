"""Through a proxy that disturbs connections: executed once, answered once."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kit.counting import served
from patience import HANG
from remote.faulty_proxy import Faults, FaultyProxy
from remote.recording import HEARTBEAT

from rlightning_aio import BatchedData, PolicyResponse, sync


def make_config(num_clients: int) -> dict[str, Any]:
    names = [f"c{k}" for k in range(num_clients)]
    return served(clients=names, heartbeat=HEARTBEAT) | {"max_restarts": 1_000_000}


def check(ends: dict[int, tuple[str, str]], folder: Path, proxy: FaultyProxy) -> dict[str, int]:
    """Compare what the trainer has got, number by number, with what each client has executed."""
    ledgers = {file.name: list(map(int, file.read_text().split())) for file in folder.iterdir()}
    for client, executed in ledgers.items():
        assert len(executed) == len(set(executed)), "a request was executed twice"
        assert {ends[number][0] for number in executed} <= {client}, "by another client"
        answered = {n for n, (one, fate) in ends.items() if one == client and fate == "answered"}
        assert answered <= set(executed), "a result that no client has made"
    fates = [name for name in ("cut", "silence") if getattr(proxy.faults, name)]
    assert all(proxy.tally[name] for name in fates), "the network had too few faults"
    return dict(Counter(fate for _, fate in ends.values()))


@pytest.mark.timeout(1500)
def test_a_fleet_of_which_robots_are_killed_and_stopped(tmp_path: Path) -> None:
    """Four of them; twenty, for some minutes, with RLIGHTNING_AIO_FLEET=20,600000,SEED and -s."""
    given = os.environ.get("RLIGHTNING_AIO_FLEET", "4,800,1")
    count, requests, seed = map(int, given.split(","))
    began = time.monotonic()
    program = [sys.executable, "-m", "remote.unlucky_clients"]
    with (
        sync.build_env_group(make_config(count)) as group,
        FaultyProxy(group["robots-0"].address, Faults(0.004, 0.002), seed) as proxy,
    ):
        clients = subprocess.Popen(
            [*program, proxy.address, str(count), str(tmp_path), str(seed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent.parent,
        )
        try:
            ends = exchange(group, requests)
        finally:
            unlucky, _ = clients.communicate("")
    assert clients.returncode == 0, "a client has failed"
    found = check(ends, tmp_path, proxy)
    sys.stdout.write(
        f"{time.monotonic() - began:.0f} s, {count} clients: {found}; the network: {proxy.tally}; "
        f"clients: {unlucky}\n"
    )


def check_first(batch: BatchedData, row: int) -> None:
    """Check a result that begins an episode."""
    _, number, steps = batch.observation[row]
    assert (number, steps, batch.reward[row]) == (-1, 0, 0), "an episode that did not begin"
    assert batch.is_reset[row]


def exchange(group: Any, requests: int) -> dict[int, tuple[str, str]]:
    """Step clients that have answered until `requests` have ended.

    Returns of each number whom it was sent to, and how it has ended.
    """
    ends: dict[int, tuple[str, str]] = {}
    asked: dict[str, int] = {}
    steps: dict[str, int] = {}
    sent = 0
    batch, _ = group.reset()
    while True:
        for row, ret in enumerate(batch.values()):
            client, number = ret.env_id.removeprefix("robots-0/"), asked.pop(ret.env_id, None)
            assert client == f"c{int(ret.observation[0])}", "the result of another client"
            action = batch.sent.action[row]
            assert np.isnan(action).all() if number is None else action[0] == number / 2**20
            is_lost = "client_lost" in ret.info
            if number is None or is_lost:
                check_first(batch, row)
            else:
                assert ret.observation[1] == number, "the result of another request"
                assert ret.last_reward == ret.observation[2] == steps[client] + 1, "a gap"
            assert batch.restarted is None or batch.restarted[row] == is_lost
            if number is not None:
                ends[number] = client, "marked" if is_lost else "answered"
            else:
                assert not is_lost, "a loss without a request"
            steps[client] = int(ret.observation[2])
        if len(ends) == requests:
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
