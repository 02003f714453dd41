"""An env that fails on demand.

An action has a fault and a token. An observation has the env's id, life, episode and step, and the
token that it answers, so each result can be checked against its request. The checks are in
`driven`, because every worker imports this module and should start quickly.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.registry import ENVS
from rlightning_aio.types import EnvRet

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.types import PolicyResponse


class OddConstructor(Exception):
    """An exception that can't be rebuilt from its arguments."""

    def __init__(self, code: int, *, where: str) -> None:
        super().__init__()
        self.code, self.where = code, where

    def __str__(self) -> str:
        return f"code {self.code} in {self.where}"


class Unpicklable(Exception):
    """An exception that holds an object that can't be pickled."""

    def __init__(self) -> None:
        super().__init__("it holds a lock")
        self.lock = threading.Lock()


class Unprintable(Exception):
    """An exception without a usable repr."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class Unspeakable(Exception):
    """An exception whose text tries to end the program."""

    def __str__(self) -> str:
        raise SystemExit(3)


class OddText(str):
    """Text that can't be pickled."""

    __slots__ = ()

    def __reduce__(self) -> str:
        raise SystemExit(4)


class OddlySpoken(Exception):
    """An exception whose text and module are no plain strings."""

    def __str__(self) -> str:
        return OddText("odd words")


OddlySpoken.__module__ = OddText("kit.faulty")
OddlySpoken.__qualname__ = OddText("OddlySpoken")


class Wordless(Exception):
    """An exception whose text is None."""

    def __str__(self) -> str:
        return self.args  # pyright: ignore[reportReturnType]  # That is odd.


class OddlyPickled(Exception):
    """An exception that tries to end the program when it is pickled."""

    def __reduce__(self) -> str:
        raise SystemExit(4)


class Untraceable(Exception):
    """An exception whose traceback can't be read."""

    __cause__ = property(lambda _: 7)  # pyright: ignore[reportAssignmentType]
    __traceback__ = property(lambda _: 1 / 0)  # pyright: ignore[reportAssignmentType]


class NotAnException(BaseException):
    """An exception that ``except Exception`` doesn't catch."""


def _raise(kind: type[BaseException], *args: Any, **kwargs: Any) -> Callable[[], None]:
    def fault() -> None:
        raise kind(*args, **kwargs)

    return fault


def _exhaust_memory() -> None:
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (2**30, before[1]))
    try:
        bytearray(2**34)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _report_and_sleep() -> None:
    sys.stderr.write("asleep\n")
    sys.stderr.flush()
    time.sleep(3600)


def _signal_trainer(number: int) -> None:
    """Send the trainer a signal once it sleeps, waiting for the reply to this request."""
    server = Path(f"/proc/{os.getppid()}/stat").read_text().rpartition(")")[2].split()
    trainer = int(server[1])
    while Path(f"/proc/{trainer}/stat").read_text().rpartition(")")[2].split()[0] != "S":
        os.sched_yield()
    os.kill(trainer, number)


def _fork(end: Callable[[], object], exit_code: int) -> Callable[[], None]:
    """Fork a child that continues from here, and wait until it has ended."""

    def fault() -> None:
        child = os.fork()
        if child == 0:
            end()
        else:
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == exit_code

    return fault


def _deadlock() -> None:
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


def _deadlock_with_the_gil() -> None:
    libc, mutex = ctypes.PyDLL(None), ctypes.create_string_buffer(64)
    libc.pthread_mutex_lock(mutex)
    libc.pthread_mutex_lock(mutex)


def _recurse() -> None:
    _recurse()


def _signal(number: int) -> Callable[[], None]:
    return lambda: os.kill(os.getpid(), number)


def _print_megabytes() -> None:
    for _ in range(3000):
        sys.stdout.write("o" * 1023 + "\n")
        sys.stderr.write("e" * 1023 + "\n")


FAULTS: dict[str, Callable[[], object]] = {
    "nothing": lambda: None,
    # Deaths.
    "sigkill": _signal(signal.SIGKILL),
    "sigterm": _signal(signal.SIGTERM),
    "segfault": lambda: ctypes.string_at(0),
    "abort": os.abort,
    "exit 0": lambda: os._exit(0),
    "exit 3": lambda: os._exit(3),
    # Hangs.
    "sleep": lambda: time.sleep(3600),
    "loop in C": lambda: sum(iter(int, 1)),
    "deadlock": _deadlock,
    "deadlock with the GIL": _deadlock_with_the_gil,
    "close descriptors": lambda: os.closerange(3, 1000),
    # To this thread: in a process with others, this thread would run on until one of them gets it.
    "stop": lambda: signal.pthread_kill(threading.get_ident(), signal.SIGSTOP),
    "report and sleep": _report_and_sleep,
    "call the trainer": lambda: _signal_trainer(signal.SIGUSR1),
    # Exceptions.
    "raise": _raise(ValueError, "as asked for"),
    "odd constructor": _raise(OddConstructor, 7, where="step"),
    "unpicklable": _raise(Unpicklable),
    "unprintable": _raise(Unprintable),
    "unspeakable": _raise(Unspeakable),
    "oddly spoken": _raise(OddlySpoken),
    "wordless": _raise(Wordless),
    "oddly pickled": _raise(OddlyPickled, "as it is"),
    "untraceable": _raise(Untraceable, "from nowhere"),
    "not an exception": _raise(NotAnException, "but raised"),
    "system exit": _raise(SystemExit, 5),
    "keyboard interrupt": _raise(KeyboardInterrupt),
    "interrupt": lambda: (os.kill(os.getpid(), signal.SIGINT), time.sleep(60)),
    "generator exit": _raise(GeneratorExit),
    "stop iteration": _raise(StopIteration, 1),
    "group of one": _raise(
        ExceptionGroup,
        "unhandled errors in a TaskGroup",
        [ExceptionGroup("inner", [KeyError("the task")])],
    ),
    "debug": breakpoint,
    "surrogates": _raise(ValueError, "\udcff"),
    "a megabyte": _raise(ValueError, "x" * 2**20),
    "broken pipe": _raise(BrokenPipeError, "the simulator's, not ours"),
    "recursion": _recurse,
    "memory": _exhaust_memory,
    # Children.
    "fork and raise": _fork(_raise(ValueError, "in a child"), 1),
    "fork and return": _fork(lambda: None, 1),
    "fork and exit": _fork(lambda: sys.exit(5), 5),
    # Noise.
    "print": _print_megabytes,
}
CODES = {name: code for code, name in enumerate(FAULTS)}
_BY_CODE = list(FAULTS.values())


@ENVS.register("faulty")
class FaultyEnv(BaseEnv):
    """Fails where it is asked to.

    ``env_kwargs``: `faults` by place (``building``, ``spaces``, ``resetting``, ``closing``); `only`
    limits them to one worker index, `while_exists` to the time while a file exists. If env 0 is
    built while the FIFO `gate` exists, it waits until another process has opened and closed it.
    """

    def __init__(self, config: Any, worker_index: int = 0, preprocess_fn: Any = None) -> None:
        super().__init__(config, worker_index, preprocess_fn)
        kwargs = self.config.env_kwargs
        self._faults: dict[str, str] = dict(kwargs.get("faults", {}))
        if kwargs.get("only", worker_index) != worker_index:
            self._faults = {}
        self._switch = kwargs.get("while_exists")
        self._resets = self._steps = 0
        self._instead: dict[str, Callable[[], Any]] = {}
        if worker_index == 0 and "gate" in kwargs and Path(kwargs["gate"]).exists():
            Path(kwargs["gate"]).read_bytes()
        self._break("building")

    def _break(self, place: str) -> None:
        fault = self._faults.get(place)
        if fault is not None and (self._switch is None or Path(self._switch).exists()):
            FAULTS[fault]()

    def get_observation_space(self) -> spaces.Box:
        self._break("spaces")
        return spaces.Box(-np.inf, np.inf, (5,), np.float64)

    def get_action_space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def _observation(self, token: float) -> np.ndarray:
        return np.array([self.worker_index, os.getpid(), self._resets, self._steps, token])

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> EnvRet:
        self._break("resetting")
        if options:
            FAULTS[options["fault"]]()
        self._resets += 1
        self._steps = 0
        return EnvRet(
            env_id=self.env_id, observation=self._observation(0), info={"resets": self._resets}
        )

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        code, token = self._preprocess_fn(policy_resp)
        _BY_CODE[int(code)]()
        self._steps += 1
        fields = {
            "env_id": self.env_id,
            "observation": self._observation(token),
            "last_reward": float(token),
            "info": {"steps": self._steps, "name": self.worker_index},
        }
        instead, self._instead = self._instead, {}
        if "result" in instead:
            return instead["result"]()
        return EnvRet(**{**fields, **{name: make() for name, make in instead.items()}})

    def do(self, fault: str) -> str:
        """Fail in a call."""
        FAULTS[fault]()
        return f"{self.env_id} did {fault}"

    def arm(self, place: str, fault: str) -> None:
        """Fail later, at `place`."""
        self._faults[place] = fault

    def answer_with(self, **instead: Callable[[], Any]) -> None:
        """Replace fields of the next step's result by the values of these functions."""
        self._instead = instead

    def returns(self, make: Callable[[], Any]) -> Any:
        """Call `make` here and return its value."""
        return make()

    def on_disconnect(self) -> None:
        sys.stderr.write(f"{self.env_id} is left alone\n")

    def close(self) -> None:
        self._break("closing")
