"""64 sessions of an OpenEnv server: our group against OpenEnv's own client under `asyncio.gather`.

A step takes 50 ms; with stragglers, one in twenty takes ten times as long. `gather` waits for one
step of all sessions, as a policy over batches needs it, or for one episode of each; our group takes
whichever are ready. The server is OpenEnv's own, under uvicorn, for everybody.

OPENENV_PYTHON names a Python that has OpenEnv; else that of `make environments` is used.
"""

# pyright: basic

from __future__ import annotations

import asyncio
import math
import os
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness import Contender, Question, Target, main

HERE = Path(__file__).resolve().parent
PYTHON = os.environ.get("OPENENV_PYTHON", str(HERE.parent / ".venv-openenv/bin/python"))
SESSIONS = 64
MIN_RESULTS = 1


@dataclass
class AtServer(Contender):
    """Has a server of its own.

    Attributes:
        kind: of its latency.
    """

    name: str
    kind: str

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio", "websockets")

    def setup(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self.server = ends("serve", self.kind, port)
        self.url = f"http://127.0.0.1:{port}"
        for _ in range(600):
            try:
                urllib.request.urlopen(f"{self.url}/health").close()
            except OSError:
                time.sleep(0.1)
                continue
            return
        raise RuntimeError("the server does not start")

    def teardown(self) -> None:
        self.server.terminate()
        self.server.wait()


@dataclass
class Ours(AtServer):
    def setup(self) -> None:
        super().setup()
        import uvloop

        self.runner = asyncio.Runner(loop_factory=uvloop.new_event_loop)
        self.runner.run(self.begin())

    async def begin(self) -> None:
        import rlightning_aio as rl

        entry = {"name": "room", "backend": "openenv", "task": self.url, "placement": "loop"}
        self.group = rl.build_env_group({**entry, "num_workers": SESSIONS})
        await self.group.init()
        self.batch, _ = await self.group.reset(seed=0)

    def round(self, seconds: float) -> float:
        return self.runner.run(self.play(seconds))

    async def play(self, seconds: float) -> float:
        action: list[Any] = [{"text": "open the door"}] * SESSIONS
        group, steps = self.group, 0
        with group.auto_reset(math.inf):
            group.step_async(self.batch.respond(action=action))
            began = time.perf_counter()
            while time.perf_counter() < began + seconds:
                batch, _ = await group.collect_async(min_results=MIN_RESULTS)
                steps += len(batch) - int(batch.is_reset.sum())
                group.step_async(batch.respond(action=action[: len(batch)]))
            rate = steps / (time.perf_counter() - began)
            self.batch, _ = await group.collect_async(wait_all=True)
        return rate

    def teardown(self) -> None:
        self.runner.run(self.group.close())
        self.runner.close()
        super().teardown()


@dataclass
class Gather(AtServer):
    """OpenEnv's client.

    Attributes:
        way: what `gather` waits for, steps or episodes.
    """

    way: str

    def setup(self) -> None:
        super().setup()
        self.client = ends("gather", self.way, self.url)
        assert self.client.stdout is not None
        assert self.client.stdout.readline() == "ready\n"

    def round(self, seconds: float) -> float:
        assert self.client.stdin is not None
        assert self.client.stdout is not None
        self.client.stdin.write(f"{seconds}\n")
        self.client.stdin.flush()
        return float(self.client.stdout.readline())

    def teardown(self) -> None:
        self.client.communicate()
        super().teardown()


def ends(what: str, kind: str, where: object) -> subprocess.Popen[str]:
    command = [PYTHON, str(HERE / "openenv_ends.py"), what, kind, str(where), str(SESSIONS)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def name(way: str, kind: str) -> str:
    return f"{way}, {kind}"


OURS, STEPS, EPISODES = "rlightning_aio", "gather over steps", "gather over episodes"
KINDS = ("even", "stragglers")

QUESTION = Question(
    name="openenv_sessions",
    title="64 sessions of an OpenEnv server",
    unit="env steps/s",
    contenders=[
        one
        for kind in KINDS
        for one in (
            Ours(name(OURS, kind), kind),
            Gather(name(STEPS, kind), kind, "steps"),
            Gather(name(EPISODES, kind), kind, "episodes"),
        )
    ],
    targets=[
        Target(name(OURS, "even"), name(STEPS, "even"), 1.0),
        Target(name(OURS, "even"), name(EPISODES, "even"), 1.0),
        Target(name(OURS, "stragglers"), name(STEPS, "stragglers"), 2.0),
        Target(name(OURS, "stragglers"), name(EPISODES, "stragglers"), 2.0),
    ],
    rounds=5,
    seconds=3.0,
)

if __name__ == "__main__":
    if not Path(PYTHON).exists():
        sys.exit(f"no Python with OpenEnv at {PYTHON}: make environments, or set OPENENV_PYTHON")
    main(QUESTION, __doc__)
