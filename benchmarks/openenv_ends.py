"""A server of OpenEnv and clients of OpenEnv's own; run by OpenEnv's Python.

    openenv_ends.py serve KIND PORT SESSIONS
    openenv_ends.py gather WAY URL SESSIONS

A client plays for as many seconds as each line of its input says, and prints steps per second.
"""

# It runs in a Python of its own, with packages that are not here.
# pyright: basic, reportMissingImports=false

from __future__ import annotations

import asyncio
import random
import sys
import time
from typing import Any

EPISODE = 10
"""Steps of an episode."""
TEXT = "You are in a room with a door to the north and a lamp on the table. " * 4


def latency(kind: str, draw: random.Random) -> float:
    """Seconds of a step: even, or one in twenty takes ten times as long."""
    return 0.5 if kind == "stragglers" and draw.random() < 0.05 else 0.05


def serve(kind: str, port: int, sessions: int) -> None:
    import uvicorn
    from openenv.core.env_server import create_app
    from openenv.core.env_server.interfaces import Environment
    from openenv.core.env_server.types import Action, Observation, State

    class Say(Action):
        text: str = ""

    class Heard(Observation):
        text: str = ""

    class Room(Environment):
        SUPPORTS_CONCURRENT_SESSIONS = True

        def __init__(self) -> None:
            super().__init__()
            self._state = State()

        def reset(self, seed: int | None = None, episode_id: str | None = None, **_: Any) -> Heard:
            self.draw = random.Random(seed)
            self._state = State(episode_id=episode_id, step_count=0)
            return Heard(text=TEXT)

        def step(self, action: Say, timeout_s: float | None = None, **_: Any) -> Heard:
            raise NotImplementedError

        async def step_async(self, action: Say, timeout_s: float | None = None, **_: Any) -> Heard:
            del action, timeout_s
            await asyncio.sleep(latency(kind, self.draw))
            self._state.step_count += 1
            return Heard(text=TEXT, reward=1.0, done=self._state.step_count == EPISODE)

        @property
        def state(self) -> State:
            return self._state

    app = create_app(Room, Say, Heard, env_name="room", max_concurrent_envs=sessions)
    uvicorn.run(app, host="127.0.0.1", port=port, log_level="warning")


async def gather(way: str, url: str, sessions: int) -> None:
    from openenv import GenericEnvClient

    async def step(env: Any) -> None:
        if (await env.step({"text": "open the door"})).done:
            await env.reset()

    async def episode(env: Any) -> None:
        while not (await env.step({"text": "open the door"})).done:
            pass
        await env.reset()

    play, worth = (step, 1) if way == "steps" else (episode, EPISODE)
    envs = [GenericEnvClient(base_url=url) for _ in range(sessions)]
    for env in envs:
        await env.connect()
    await asyncio.gather(*(env.reset(seed=k) for k, env in enumerate(envs)))
    print("ready", flush=True)
    while line := await asyncio.to_thread(sys.stdin.readline):
        steps, began = 0, time.perf_counter()
        while time.perf_counter() < began + float(line):
            await asyncio.gather(*(play(env) for env in envs))
            steps += worth * sessions
        print(steps / (time.perf_counter() - began), flush=True)


if __name__ == "__main__":
    what, kind, where, count = sys.argv[1:]
    if what == "serve":
        serve(kind, int(where), int(count))
    else:
        asyncio.run(gather(kind, where, int(count)))
