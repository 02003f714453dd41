"""The `openenv` backend with OpenEnv itself, which has its own Python."""

from __future__ import annotations

import asyncio
import json
import os
import random
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
from rlightning_aio import attempts
from rlightning_aio.attempts import EpisodeSpec, Rules

if TYPE_CHECKING:
    from collections.abc import Generator

    from rlightning_aio.attempts import AttemptEpisode, AttemptGroup

HERE = Path(__file__).parent
PYTHON = os.environ.get("OPENENV_PYTHON", "")
OPENENV = [PYTHON, str(HERE / "openenv_server.py")]
# It is to be as fast as usual, and errors of tools that are meant to be are no news.
AS_USUAL = {k: v for k, v in os.environ.items() if k != "PYTHONASYNCIODEBUG"}
AS_USUAL["FASTMCP_LOG_LEVEL"] = "CRITICAL"
pytestmark = [
    pytest.mark.simulators,
    pytest.mark.skipif(not PYTHON, reason="OPENENV_PYTHON names no Python with OpenEnv"),
]


@contextmanager
def served(kind: str, sessions: int) -> Generator[tuple[str, subprocess.Popen[bytes]]]:
    """The address of an OpenEnv server that listens, and its process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen([*OPENENV, "serve", kind, str(port), str(sessions)], env=AS_USUAL)
    try:
        url = f"http://127.0.0.1:{port}"
        wait_for(url)
        yield url, process
    finally:
        process.kill()  # Its steps may never end.
        process.wait()


CUT = {"truncated_field": "late", "columns": {"total": 1000}}


@pytest.mark.parametrize("kind", ["dice", "echo", "tools"])
def test_sessions_equal_stepping_the_env_directly(kind: str) -> None:
    """Observations, rewards, ends and metadata, over 64 sessions, here and in a worker."""
    episodes = int(os.environ.get("RLIGHTNING_AIO_EPISODES", "2"))
    command = [*OPENENV, "direct", kind, "64", str(episodes)]
    with (
        served(kind, 64) as (url, _),
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


def test_attempts_over_servers_of_openenv() -> None:
    """Some are cut off in a step that never ends; later one of the two servers is killed."""
    with served("dice", 64) as (first, process), served("dice", 64) as (second, _):
        kwargs = {"truncated_field": "late", "urls": [second]}
        fields = {"backend": "openenv", "env_kwargs": kwargs, "placement": "loop"}
        entry = {"name": "dice", "task": first, "num_workers": 8, **fields}
        cut, killed = asyncio.run(attempts_over(entry, process), debug=False)
    for found in cut:
        kinds = [attempt.outcome.kind for attempt in found]
        assert kinds == ["cancelled", "terminated", "terminated"]
        assert found[0].reward is None
    failures = [(o.kind, o.blame) for found in killed for a in found for o in a.failures]
    assert failures == [("env_away", "infrastructure")] * 4  # Every second of eight sessions.
    whole = [a for found in (*cut, *killed) for a in found if a.reward is not None]
    assert len(whole) == 12 * 2 + 6 * 4
    for attempt in whole:
        rolls = random.Random(attempt.spec.seed)
        assert (attempt.rewards, attempt.reward) == ([4.0] * 3, 12.0)
        assert attempt.last == {"total": 12, "roll": [rolls.random() for _ in range(4)][-1]}


async def attempts_over(
    entry: dict[str, Any], process: subprocess.Popen[bytes]
) -> tuple[list[AttemptGroup], list[AttemptGroup]]:
    """Play groups whose first attempt hangs, then groups while the server is killed."""
    flying, go_on = 0, asyncio.Event()

    async def some_hang(episode: AttemptEpisode) -> None:
        if episode.index == 0:
            await episode.step({"move": -1})
        await to_the_end(episode)

    async def survivor(episode: AttemptEpisode) -> None:
        nonlocal flying
        flying += 1
        if flying == 8:
            process.kill()
            process.wait()
            go_on.set()
        await go_on.wait()
        await to_the_end(episode)

    async def to_the_end(episode: AttemptEpisode) -> None:
        while not episode.is_over:
            await episode.step({"move": 4})

    tasks = [EpisodeSpec("", seed) for seed in range(12)]
    async with rl.build_env_group(entry) as group, asyncio.timeout(HANG):
        cut = [one async for one in attempts.play(group, tasks, some_hang, 3, Rules(first=2))]
        assert group.pending == []
        killed = [one async for one in attempts.play(group, tasks[:6], survivor, 4)]
    return cut, killed


def wait_for(url: str) -> None:
    """Wait until a server listens, which takes as long as its imports."""
    while True:
        try:
            urllib.request.urlopen(f"{url}/health").close()  # It is of this machine.
        except OSError:
            time.sleep(0.05)
        else:
            return
