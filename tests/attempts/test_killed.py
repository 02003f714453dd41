"""An interrupted or killed run goes on from its file: each attempt is there once, as without."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from attempts.room import Room

import rlightning_aio as rl
from rlightning_aio.attempts import EpisodeSpec, ResultsFile, play

KILLS = int(os.environ.get("RLIGHTNING_AIO_KILLS", "3"))
TASKS, SIZE = 4 * KILLS, 3
SIGNALS = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT]


async def agent(episode: Any) -> int:
    while not episode.is_over:
        await asyncio.sleep(0.005)
        await episode.step(episode.last.observation["seed"] + episode.index)
    return episode.index


async def run(path: str) -> None:
    tasks = [EpisodeSpec("", seed) for seed in range(TASKS)]
    async with rl.build_env_group(Room, name="room", num_workers=2) as group:
        with ResultsFile(path, {"agent": "adds its index"}) as results:
            async for _ in play(group, tasks, agent, SIZE, results=results):
                pass


def rows(path: Path) -> list[tuple[Any, ...]]:
    lines = [json.loads(line) for line in path.read_text().splitlines()[1:]]
    lines = [line for line in lines if "seed" in line]  # Others say what was handed out.
    return sorted(
        (line["seed"], line["index"], line["reward"], line["outcome"]["kind"], line["result"])
        for line in lines
    )


def lines_in(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def test_a_run_that_is_killed_goes_on(tmp_path: Path) -> None:
    """Several times by each of the signals, at any moment after some more attempts have ended."""
    path, whole = tmp_path / "killed.jsonl", tmp_path / "whole.jsonl"
    command = [sys.executable, "-m", "attempts.test_killed", str(path)]
    surroundings = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    for number in itertools.islice(itertools.cycle(SIGNALS), KILLS):
        before = lines_in(path)
        process = subprocess.Popen(command, env=surroundings)
        while lines_in(path) < before + 5 and process.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.01)
        process.send_signal(number)
        assert process.wait() != 0
        assert (process.returncode == -signal.SIGKILL) == (number == signal.SIGKILL)
    subprocess.run(command, check=True, env=surroundings)
    rl.run(run(str(whole)))
    assert rows(path) == rows(whole)
    assert len(rows(path)) == TASKS * SIZE


if __name__ == "__main__":
    rl.run(run(sys.argv[1]))
