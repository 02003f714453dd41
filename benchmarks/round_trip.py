"""One env in one worker, with no work in it: how long does a call of `step` take?

It is compared with the operating system's time for the same wake-ups: two processes that send
each other one byte through a socket pair and block in between. Only the call is timed,
and the figure of a round is the median over its calls.
"""

from __future__ import annotations

import multiprocessing as mp
import socket
import statistics
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import no_work
from contenders import OursAsync, OursSync, Work
from harness import Contender, Question, Target, main

if TYPE_CHECKING:
    from collections.abc import Callable

WORK = Work(no_work.NO_WORK, num_envs=1, modules=("no_work",))
WARM_UP_CALLS = 20

SYNC = "rlightning_aio sync"
UVLOOP = "rlightning_aio async, uvloop"
ASYNCIO = "rlightning_aio async, asyncio"
PING_PONG = "one byte there and back"


def median_us(call: Callable[[], object], seconds: float) -> float:
    clock = time.perf_counter_ns
    for _ in range(WARM_UP_CALLS):
        call()
    times: list[int] = []
    until = clock() + int(seconds * 1e9)
    began = clock()
    while began < until:
        call()
        ended = clock()
        times.append(ended - began)
        began = clock()
    return statistics.median(times) / 1e3


@dataclass
class SyncCalls(OursSync):
    def round(self, seconds: float) -> float:
        response = self._batch.respond(action=next(self._actions))
        return median_us(lambda: self._envs.step(response), seconds)


@dataclass
class AsyncCalls(OursAsync):
    def begin(self) -> None:
        """Do nothing: a call is a request and its reply."""

    async def measure(self, seconds: float) -> float:
        clock = time.perf_counter_ns
        response = self._first.respond(action=next(self._actions))
        for _ in range(WARM_UP_CALLS):
            await self._envs.step(response)
        times: list[int] = []
        until = clock() + int(seconds * 1e9)
        began = clock()
        while began < until:
            await self._envs.step(response)
            ended = clock()
            times.append(ended - began)
            began = clock()
        return statistics.median(times) / 1e3


def _echo(channel: socket.socket) -> None:
    while data := channel.recv(1):
        channel.send(data)


@dataclass
class PingPong(Contender):
    name: str

    def setup(self) -> None:
        self._channel, theirs = socket.socketpair()
        self._process = mp.get_context("spawn").Process(target=_echo, args=(theirs,))
        self._process.start()
        theirs.close()

    def _call(self) -> None:
        self._channel.send(b"!")
        self._channel.recv(1)

    def round(self, seconds: float) -> float:
        return median_us(self._call, seconds)

    def teardown(self) -> None:
        self._channel.close()
        self._process.join()


QUESTION = Question(
    name="round_trip",
    title="Round trip of step, 1 env without work in 1 worker",
    unit="µs",
    contenders=[
        SyncCalls(SYNC, WORK, auto_reset=False),
        AsyncCalls(UVLOOP, WORK, auto_reset=False),
        AsyncCalls(ASYNCIO, WORK, auto_reset=False, uvloop=False),
        PingPong(PING_PONG),
    ],
    targets=[
        Target(SYNC, PING_PONG, 1.25, at_most=True),
        Target(UVLOOP, PING_PONG, 1.5, at_most=True),
    ],
    seconds=1.0,
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
