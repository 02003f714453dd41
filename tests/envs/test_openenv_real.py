"""The `openenv` backend with OpenEnv itself, which has its own Python."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import time
import urllib.request
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from envs.openenv_actions import STEPS, action_of, seed_of
from patience import HANG

import rlightning_aio as rl

if TYPE_CHECKING:
    from collections.abc import Generator

HERE = Path(__file__).parent
PYTHON = os.environ.get("OPENENV_PYTHON", "")
OPENENV = [PYTHON, str(HERE / "openenv_server.py")]
# It is to be as fast as usual.
AS_USUAL = {k: v for k, v in os.environ.items() if k != "PYTHONASYNCIODEBUG"}
pytestmark = [
    pytest.mark.simulators,
    pytest.mark.skipif(not PYTHON, reason="OPENENV_PYTHON names no Python with OpenEnv"),
]


@contextmanager
def served(kind: str, sessions: int) -> Generator[str]:
    """The address of an OpenEnv server that listens."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen([*OPENENV, "serve", kind, str(port), str(sessions)], env=AS_USUAL)
    try:
        url = f"http://127.0.0.1:{port}"
        wait_for(url)
        yield url
    finally:
        process.kill()
        process.wait()


CUT = {"truncated_field": "late", "columns": {"total": 1000}}


@pytest.mark.parametrize("kind", ["dice", "echo"])
def test_sessions_equal_stepping_the_env_directly(kind: str) -> None:
    """Observations, rewards, ends and metadata, over 64 sessions, here and in a worker."""
    episodes = int(os.environ.get("RLIGHTNING_AIO_EPISODES", "2"))
    command = [*OPENENV, "direct", kind, "64", str(episodes)]
    with (
        served(kind, 64) as url,
        subprocess.Popen(command, stdout=subprocess.PIPE, env=AS_USUAL) as direct,
    ):
        found = [
            asyncio.run(play(kind, url, placement, 64, episodes), debug=False)
            for placement in ("loop", "process")
        ]
        assert direct.stdout is not None
        expected = json.load(direct.stdout)
    assert found == [expected, expected]
    print(f"{kind}: {sum(len(rows) for rows in chain(*expected))} equal results")  # noqa: T201


async def play(
    kind: str, url: str, placement: str, count: int, episodes: int
) -> list[list[list[Any]]]:
    """Rows of observation, reward, done and metadata: of each session, each episode."""
    kwargs = CUT if kind == "dice" else {}
    entry = {"name": "d", "backend": "openenv", "task": url, "num_workers": count}
    entry |= {"placement": placement, "env_kwargs": kwargs, "close_timeout": HANG}
    played: list[list[list[Any]]] = [[] for _ in range(count)]
    async with rl.build_env_group(entry) as group:
        for episode in range(episodes):
            batch, _ = await group.reset(seed=[seed_of(k, episode) for k in range(count)])
            for k, row in enumerate(rows_of(batch)):
                played[k].append([row])
            running = list(range(count))
            for step in range(STEPS):
                steps = [
                    rl.PolicyResponse(f"d-{k}", action_of(kind, k, episode, step)) for k in running
                ]
                batch, _ = await group.step(rl.BatchedData([one.env_id for one in steps], steps))
                for k, row in zip(running, rows_of(batch), strict=True):
                    played[k][-1].append(row)
                running = [k for k, done in zip(running, batch.done, strict=True) if not done]
                if not running:
                    break
    return played


def rows_of(batch: Any) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for ret in batch.values():
        observation, metadata = ret.observation, dict(ret.info)
        if "rest" in observation:
            observation = {"total": observation["total"].item(), **observation["rest"]}
            assert ret.last_truncated == metadata.get("late", False)
        done = ret.last_terminated or ret.last_truncated
        assert done == ("episode" in metadata)
        metadata.pop("episode", None)  # The group's own.
        rows.append([observation, ret.last_reward, done, metadata])
    return rows


def wait_for(url: str) -> None:
    """Wait until a server listens, which takes as long as its imports."""
    while True:
        try:
            urllib.request.urlopen(f"{url}/health").close()  # It is of this machine.
        except OSError:
            time.sleep(0.05)
        else:
            return
