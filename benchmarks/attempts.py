"""Attempts of agents: while much fails, and thousands at once.

    python benchmarks/attempts.py --faults

200 tasks are attempted 8 times each in 64 sandboxes of an HTTP server, a process of its own with a
ledger. Of the attempts, 2 % meet an error and 1 % a step that hangs; one sandbox is broken for
good, the server is away for 3 s, and the trainer holds the event loop after each group.

    python benchmarks/attempts.py

2,000 attempts of ten steps in flight, whose steps wait for a second on average on the event loop,
or for a tenth of it in worker processes (log-normal): how late the loop is, with the start of all
of them, and what a step costs the trainer's thread, with its share of the starts and ends.

A run that is interrupted ten times, and goes on from its file, is a test:

    RLIGHTNING_AIO_KILLS=10 python -m pytest tests/attempts/test_killed.py
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import multiprocessing
import random
import time
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from harness import machine_facts
from waiting import Awaiting

import rlightning_aio as rl
from rlightning_aio.attempts import EpisodeSpec, Rules, play
from rlightning_aio.errors import EnvError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.connection import Connection

SANDBOXES, SIZE, STEPS, STEP_SECONDS = 64, 8, 4, 0.02
FAILING, HANGING, AWAY_AFTER = 0.02, 0.01, 0.5
"""Shares of the attempts, and after how many seconds the server is away."""
IN_FLIGHT, LONG = 2000, 10
FLIGHTS: Final = {"loop": 1.0, "process": 0.1}
"""Of attempts: the placement, and the mean seconds of a step."""


class Service:
    """What the server knows: the sum of rewards by session, and which sessions are open."""

    def __init__(self, away: float) -> None:
        self.ledger: dict[str, float] = {}
        self.open = set[str]()
        self.faults, self.random = away > 0, random.Random(0)
        self.away, self.back = away, time.monotonic() + AWAY_AFTER + away

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request: its path is what is to be done, and with what."""
        what, *about = (await reader.readline()).decode().split()[1].strip("/").split("/")
        if not 0 < self.back - time.monotonic() < self.away or what == "ledger":
            reply = await self.done(what, *about)
            writer.write(f"HTTP/1.0 {200 if reply is not None else 500}\r\n\r\n".encode())
            writer.write(json.dumps(reply).encode())
        writer.close()

    async def done(self, what: str, *about: str) -> Any:
        if what == "ledger":
            return {"ledger": self.ledger, "open": sorted(self.open)}
        if what == "delete":
            return self.open.discard(about[0]) or True
        chance = self.random.random() * STEPS if self.faults else 1.0
        if (self.faults and about[0] == "broken") or (what == "step" and chance < FAILING):
            return None
        if what == "create":
            self.open.add(session := str(len(self.ledger)))
            self.ledger[session] = 0.0
            return session
        await asyncio.sleep(3600 if chance < FAILING + HANGING else STEP_SECONDS)
        reward = float(self.random.randrange(5))
        self.ledger[about[0]] += reward
        return reward


def serve(pipe: Connection, away: float) -> None:
    async def main() -> None:
        server = await asyncio.start_server(Service(away).answer, "127.0.0.1")
        pipe.send(server.sockets[0].getsockname()[1])
        await server.serve_forever()

    asyncio.run(main())


async def asked(port: int, *words: str) -> Any:
    """Ask the server; its failures are those of the infrastructure."""
    try:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET /{'/'.join(words)} HTTP/1.0\r\n\r\n".encode())
        head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
        writer.close()
    except OSError as error:
        raise EnvError(f"no answer: {error}", blame="infrastructure") from error
    if " 200" not in head:
        raise EnvError(f"the server said {head or 'nothing'}", blame="infrastructure")
    return json.loads(body)


class Sandbox:
    """One of the server, ``whole`` or ``broken``; its observation is the number of its session."""

    def __init__(self, port: int, kind: str) -> None:
        self.port, self.kind, self.session = port, kind, ""

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:  # noqa: ARG002
        await self.close()
        self.steps, self.session = 0, await asked(self.port, "create", self.kind)
        return self.session, {}

    async def step(self, action: Any) -> Any:  # noqa: ARG002
        self.steps += 1
        reward = await asked(self.port, "step", self.session)
        return self.session, reward, self.steps == STEPS, False, {}

    async def close(self) -> None:
        while self.session:  # Whatever it takes: a sandbox costs money.
            try:
                await asked(self.port, "delete", self.session)
                self.session = ""
            except EnvError:
                await asyncio.sleep(0.2)


async def agent(episode: Any) -> str:
    while not episode.is_over:
        await episode.step("go")
    return episode.last.observation


async def in_sandboxes(port: int, number: int, blocked: float) -> dict[str, Any]:
    """Play all attempts, and compare them with the ledger."""
    groups, began = list[Any](), time.monotonic()
    limits: dict[str, Any] = {"step_timeout": 2.0, "reset_timeout": 10.0, "max_restarts": 100}
    kinds = ["broken", *["whole"] * (SANDBOXES - 1)]
    boxes = [partial(Sandbox, port, kind) for kind in kinds]
    async with rl.build_env_group(boxes, placement="loop", **limits) as group:
        specs = (EpisodeSpec("", seed) for seed in range(number))
        async for attempts in play(group, specs, agent, SIZE, Rules(attempt_timeout=20)):
            time.sleep(blocked)  # noqa: ASYNC251  # The update of the weights.
            groups.append(attempts)
    seconds = time.monotonic() - began
    known = await asked(port, "ledger")
    each = [one for attempts in groups for one in attempts]
    whole = [one for one in each if one.reward is not None]
    failed = [one.outcome for one in each if one.reward is None]
    return {
        "groups": len(groups),
        "complete": sum(attempts.is_complete for attempts in groups),
        "failed": Counter(f"{one.kind}: {one.cause}" for one in failed),
        "tries that failed": Counter(own.kind for one in each for own in one.failures),
        "wrong rewards": sum(one.reward != known["ledger"][one.result] for one in whole),
        "sandboxes left": len(known["open"]),
        "seconds": seconds,
    }


def faulty(number: int, away: float, blocked: float) -> dict[str, Any]:
    """Play with faults, and without."""
    found: dict[str, Any] = {}
    for name, lasts in (("with faults", away), ("without", 0.0)):
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.Process(target=serve, args=(theirs, lasts))
        process.start()
        found[name] = rl.run(in_sandboxes(ours.recv(), number, blocked if lasts else 0.0))
        process.kill()
        process.join()
    return found


async def watch(lags: list[float]) -> None:
    """Note how late the event loop is."""
    while True:
        began = time.monotonic()
        await asyncio.sleep(0.005)
        lags.append(time.monotonic() - began - 0.005)


def lag_of(lags: list[float]) -> dict[str, float]:
    lags.sort()
    return {"lag_p99_ms": 1e3 * lags[int(0.99 * len(lags))], "lag_max_ms": 1e3 * lags[-1]}


async def many(number: int, seconds: float, placement: str, mean: float) -> dict[str, float]:
    """Keep a number of attempts in flight for some seconds; `mean` is that of a step."""
    steps, lags = 0, list[float]()

    async def agent(episode: Any) -> None:
        nonlocal steps
        while not episode.is_over:
            await episode.step(0)
            steps += 1

    def tasks() -> Iterator[EpisodeSpec]:
        until = time.monotonic() + seconds
        for seed in itertools.takewhile(lambda _: time.monotonic() < until, itertools.count()):
            yield EpisodeSpec("", seed)

    fields: dict[str, Any] = {"placement": placement, "step_timeout": 60}
    async with rl.build_env_group(
        Awaiting, num_workers=number, env_kwargs={"mean": mean, "length": LONG}, **fields
    ) as group:
        spent = time.thread_time()
        watching = asyncio.create_task(watch(lags))
        async for attempts in play(group, tasks(), agent, SIZE):
            assert attempts.is_complete
        watching.cancel()
        spent = time.thread_time() - spent
    return {**lag_of(lags), "us_per_step": 1e6 * spent / steps}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--faults", action="store_true", help="play while much fails")
    parser.add_argument("--tasks", type=int, default=200, help="with --faults")
    parser.add_argument("--away", type=float, default=3.0, help="seconds of the server")
    parser.add_argument("--blocked", type=float, default=2.0, help="seconds after each group")
    parser.add_argument("--seconds", type=float, default=10.0, help="of attempts in flight")
    parser.add_argument("--in-flight", type=int, default=IN_FLIGHT, help="8 or a multiple")
    args = parser.parse_args()
    report: dict[str, Any] = {"machine": machine_facts(("rlightning_aio", "uvloop"))}
    if args.faults:
        report |= faulty(args.tasks, args.away, args.blocked)
    else:
        report["in_flight"] = {
            placement: rl.run(many(args.in_flight, args.seconds, placement, mean))
            for placement, mean in FLIGHTS.items()
        }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
