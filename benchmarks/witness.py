"""An environment that identifies itself in all its values, and fails in every possible way.

An observation has the environment's index, its process and the parent process, its life (a
different number for each time that it is built), its episode, its step, the token of the action
that it answers, and a checksum of all these. So a row of another environment, step or life, or a
mixture of two rows, is noticed. Workers import this module through a config entry's ``imports``.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
import string
import sys
import threading
import time
import zlib
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Text

from rlightning_aio.envs.gymnasium import GymnasiumEnv
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Callable

INDEX, PID, PARENT, LIFE, EPISODE, STEPS, TOKEN, CHECK = range(8)
BLOB_BYTES = 1 << 18
FLOOD_LINES = 200
DEAF_SECONDS = 2.5
"""How long an awaitable environment ignores that it is cancelled: longer than its step may take."""


def checksum(named: np.ndarray) -> float:
    """Return a checksum of an observation's numbers."""
    return float(zlib.crc32(np.ascontiguousarray(named[:CHECK], np.float64).tobytes()))


class OddError(Exception):
    """Can't be rebuilt from its arguments, and holds an object that can't be pickled."""

    def __init__(self, *, code: int) -> None:
        super().__init__()
        self.code, self.lock = code, threading.Lock()

    def __str__(self) -> str:
        return f"code {self.code}"


class Unprintable(Exception):
    """Has no usable repr."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class NotAnException(BaseException):
    """An exception that ``except Exception`` doesn't catch."""


def _raise(kind: type[BaseException], *args: Any, **kwargs: Any) -> Callable[[], None]:
    def fault() -> None:
        raise kind(*args, **kwargs)

    return fault


def _sleep_long() -> None:
    time.sleep(3600)


def _compute_long() -> None:
    sum(iter(int, 1))


def _deadlock() -> None:
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


def _close_descriptors() -> None:
    os.closerange(3, 256)
    _sleep_long()


def _stop() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def _nap() -> None:
    """Hang as far as the group can see, then continue: a client's process is not killed."""
    time.sleep(2.5)


def _segfault() -> None:
    ctypes.string_at(0)


def _exit() -> None:
    os._exit(3)


def _fork(fault: Callable[[], None]) -> Callable[[], None]:
    def forked() -> None:
        pid = os.fork()
        if not pid:
            fault()
        os.waitpid(pid, 0)

    return forked


def _flood_stderr() -> None:
    for _ in range(FLOOD_LINES):
        sys.stderr.write("e" * 1023 + "\n")
        sys.stdout.write("o" * 1023 + "\n")


def _lag() -> None:
    time.sleep(0.02)


def _block() -> None:
    time.sleep(0.15)


def _nothing() -> None: ...


FAULTS: dict[str, Callable[[], None]] = {
    "nothing": _nothing,
    "end": _nothing,
    "lag": _lag,
    # Raise.
    "raise": _raise(ValueError, "as asked for"),
    "raise oddly": _raise(OddError, code=7),
    "raise unprintably": _raise(Unprintable),
    "raise no exception": _raise(NotAnException, "but raised"),
    "raise SystemExit": _raise(SystemExit, 5),
    "raise KeyboardInterrupt": _raise(KeyboardInterrupt),
    "raise StopIteration": _raise(StopIteration, 1),
    "raise GeneratorExit": _raise(GeneratorExit),
    "raise surrogates": _raise(ValueError, "\udcff"),
    "raise CancelledError": _raise(asyncio.CancelledError, "its own"),
    # Die.
    "exit": _exit,
    "crash": _segfault,
    # Hang.
    "sleep": _sleep_long,
    "compute": _compute_long,
    "deadlock": _deadlock,
    "stop itself": _stop,
    "close descriptors": _close_descriptors,
    "nap": _nap,
    # Fork.
    "fork, child exits": _fork(_exit),
    "fork, child raises": _fork(_raise(ValueError, "in a child")),
    "fork, child leaves": _fork(_raise(SystemExit, 0)),
    # Print.
    "flood stderr": _flood_stderr,
    "big info": _nothing,
    "nested info": _nothing,
    # It holds the event loop, if it is on one.
    "block": _block,
    # It is awaitable: see `AWAITED`.
    "await forever": _nothing,
    "ignore cancellation": _nothing,
    "leave a task": _nothing,
}


async def _await_forever() -> None:
    await asyncio.Event().wait()


async def _ignore_cancellation() -> None:
    until = time.monotonic() + DEAF_SECONDS
    while (left := until - time.monotonic()) > 0:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(left)


async def _leave_task() -> None:
    _left.add(task := asyncio.create_task(_await_forever(), name="left by a witness"))
    task.add_done_callback(_left.discard)


_left: set[asyncio.Task[None]] = set()
AWAITED = {
    "await forever": _await_forever,
    "ignore cancellation": _ignore_cancellation,
    "leave a task": _leave_task,
}
"""What an awaitable environment does before its step."""
CODES = {name: code for code, name in enumerate(FAULTS)}
NAMES = list(FAULTS)
BUILD_FAULTS = ("nothing", "raise", "exit", "sleep")
"""Faults of the next build of an environment, by number."""


def extra_info(name: str, token: float) -> dict[str, Any]:
    """Return the additional info that an action may request."""
    if name == "big info":
        return {"blob": bytes([int(token) % 251]) * BLOB_BYTES}
    if name == "nested info":
        return {"nested": {"token": token, "array": np.arange(5.0) + token, "words": ["a", {}]}}
    return {}


_LETTERS = string.ascii_letters + string.digits
SPACES: dict[str, gym.Space[Any]] = {
    "vector": Box(-np.inf, np.inf, (8,), np.float64),
    "halves": Dict(
        {
            "head": Box(-np.inf, np.inf, (4,), np.float64),
            "tail": Box(-np.inf, np.inf, (4,), np.float64),
        }
    ),
    "text": Dict(
        {"named": Box(-np.inf, np.inf, (8,), np.float64), "text": Text(64, charset=_LETTERS)}
    ),
}


def vector_of(layout: str, observation: Any) -> np.ndarray:
    """Return the numbers of an observation of any layout."""
    if layout == "vector":
        return observation
    if layout == "halves":
        return np.concatenate((observation["head"], observation["tail"]))
    named = observation["named"]
    if observation["text"] != f"e{int(named[INDEX])}t{int(named[TOKEN])}":
        raise ValueError(f"the text of another: {observation}")
    return named


class Witness(gym.Env[Any, Any]):
    """The environment; see the module's docstring.

    Args:
        index: its number in observations.
        layout: of its observations, see `SPACES`.
        orders: a file with a byte for each environment: the fault of its next build.
    """

    action_space = Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, index: int, layout: str = "vector", orders: str | None = None) -> None:
        self.observation_space = SPACES[layout]
        self._index = index
        self._layout = layout
        self.life = float(int.from_bytes(os.urandom(6), "little"))
        self._episode = self._steps = 0
        self._seed: Any = None
        if orders is not None:
            self._obey(orders)

    def _obey(self, orders: str) -> None:
        with open(orders, "r+b", buffering=0) as file:  # noqa: PTH123
            file.seek(self._index)
            order = file.read(1)[0]
            file.seek(self._index)
            file.write(b"\0")
        FAULTS[BUILD_FAULTS[order]]()

    def _result(self, token: float, name: str) -> tuple[Any, dict[str, Any]]:
        named = np.array(
            [
                self._index, os.getpid(), os.getppid(), self.life, self._episode, self._steps,
                token, 0.0,
            ]
        )  # fmt: skip
        named[CHECK] = checksum(named)
        info = {
            "index": self._index,
            "life": self.life,
            "episode": self._episode,
            "steps": self._steps,
            "token": float(token),
            **extra_info(name, float(token)),
        }
        if self._layout == "vector":
            return named, info
        if self._layout == "halves":
            return {"head": named[:4], "tail": named[4:]}, info
        return {"named": named, "text": f"e{self._index}t{int(token)}"}, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        if options:
            FAULTS[options["fault"]]()
        self._episode += 1
        self._steps = 0
        observation, info = self._result(0.0, "nothing")
        return observation, {**info, "seed": -1 if seed is None else int(seed)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        code, token = action
        name = NAMES[int(code)]
        FAULTS[name]()
        self._steps += 1
        observation, info = self._result(token, name)
        return observation, float(token), name == "end", False, info

    def describe(self, echo: Any) -> tuple[int, float, int, int, Any]:
        """Return the identity, the progress and the argument."""
        return self._index, self.life, self._episode, self._steps, echo

    def do(self, fault: str) -> None:
        """Fail in a call."""
        FAULTS[fault]()


@ENVS.register("witness")
class WitnessEnv(GymnasiumEnv):
    """`Witness` as a backend: its index is the worker index."""

    def _make(self) -> Any:
        return Witness(self.worker_index, **self.config.env_kwargs)


@ENVS.register("awaitable witness")
class AwaitableWitness(WitnessEnv):
    """The same with `async def`."""

    async def reset(self, **kwargs: Any) -> Any:  # type: ignore[override]
        await asyncio.sleep(0)
        return super().reset(**kwargs)

    async def step(self, policy_resp: Any) -> Any:  # type: ignore[override]
        await asyncio.sleep(0)
        name = NAMES[int(policy_resp.action[0])]
        if name in AWAITED:
            await AWAITED[name]()
        return super().step(policy_resp)

    def bare_step(self) -> None:
        return None

    async def close(self) -> None:  # type: ignore[override]
        await asyncio.sleep(0)
        super().close()
