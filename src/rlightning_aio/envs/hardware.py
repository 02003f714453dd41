"""What a host or a client does for the safety of an env that moves something real.

Rule: an action that its space does not contain never reaches it, and whatever goes wrong stops it.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import math
import os
import signal
import time
from threading import Event, Lock, Thread, current_thread, main_thread
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.envs.fast_path import FastPath
from rlightning_aio.envs.results import has_preprocess_fn, input_of, is_async_first, is_awaitable
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.protocol.columns import Misfit, fitted_tree, leaves, out_of_bounds
from rlightning_aio.trees import as_numpy, mapped

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.types import PolicyResponse

_log = logging.getLogger("rlightning_aio")

_LOOK_SECONDS: Final = 0.01
"""Time between two looks at whether an env at work must stop."""
_STOP_SECONDS: Final = 0.1
"""How long others wait for the stop of an env, which may hang."""
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
ACTION_TIMEOUT: Final = "action_timeout"
"""In `env_kwargs` of an entry of hardware: see `limit_actions`."""
HELD: Final[set[BaseEnv]] = set()
"""What a trainer's own process, or a client's, has and has not closed: it stops with that."""
os.register_at_fork(after_in_child=HELD.clear)


def says_hardware(env: BaseEnv) -> bool:
    """Return True if an env, or what it wraps, says by ``hardware = True`` what it is."""
    made: Any = env.env
    return env.hardware or getattr(getattr(made, "unwrapped", made), "hardware", False) is True


def stop(env: BaseEnv) -> None:
    """Stop what `env` moves; what that raises is logged."""
    try:
        env.stop()
    except Exception:  # noqa: BLE001 - others must be stopped, too
        _log.exception("env %r could not be stopped", env.env_id)


@atexit.register
def _stop_held() -> None:
    for env in list(HELD):  # One after the other: no thread can be started any more.
        stop(env)


def begin_stops(envs: Iterable[BaseEnv]) -> list[Thread]:
    """Stop `envs` at the same time, as a stop takes some time; return the threads that do it."""
    threads = [Thread(target=stop, args=[env], name="stops hardware", daemon=True) for env in envs]
    for thread in threads:
        thread.start()
    return threads


def stop_all(envs: Iterable[BaseEnv]) -> None:
    """Stop `envs` at the same time, and wait until they have stopped, or for a moment each."""
    for thread in begin_stops(envs):
        thread.join(_STOP_SECONDS)


def checked_input_of(env: BaseEnv) -> Callable[[Any, dict[str, Any]], Any]:
    """Return `input_of(env)` that refuses actions which the env's action space does not contain.

    They are cast to the dtypes of the space first. The actions of an env with
    `transforms_actions` pass, and of one with a preprocess function those that it returns are
    looked at.

    Raises (from the function):
        BadAction: the space does not contain the action.
    """
    if env.transforms_actions:
        return input_of(env)
    if has_preprocess_fn(env):
        preprocess = env._preprocess_fn  # pyright: ignore[reportPrivateUsage]

        def checked(policy_resp: PolicyResponse) -> Any:
            return _fitting(env, preprocess(policy_resp))

        env._preprocess_fn = checked  # pyright: ignore[reportPrivateUsage]
        return input_of(env)
    make = input_of(env)
    return lambda action, extras: make(_fitting(env, action), extras)


def _fitting(env: BaseEnv, action: Any) -> Any:
    """Return `action`, cast to the dtypes of the action space."""
    space = env.get_action_space()
    fault = None
    if leaves(space) is not None:
        try:
            action = mapped(lambda array: array[()], fitted_tree(space, as_numpy(action), "it"))
        except Misfit as misfit:
            fault = str(misfit)
    if fault is None and not space.contains(action):
        fault = out_of_bounds(space, action, "it") or f"{space} does not contain {action!r}"
    if fault is None:
        return action
    raise BadAction(f"{env.env_id}: an action was refused: {fault}; the env got none and stops")


def watched(due: Callable[[], Iterable[BaseEnv]]) -> Callable[[], None]:
    """Have a thread stop envs, even while they are at work in another thread.

    Args:
        due: returns the envs to stop now. One that is at work is returned until its work ends,
            as it may have begun to move after it was stopped.

    Returns a function that ends this, once those that are due then were stopped. Idempotent.
    """
    is_over = Event()

    def watch() -> None:
        is_last = False
        stops: dict[int, Thread] = {}  # That still run: one that hangs is not begun again.
        while not is_last:
            is_last = is_over.is_set()
            stops = {key: thread for key, thread in stops.items() if thread.is_alive()}
            envs = [env for env in due() if id(env) not in stops]
            stops |= zip(map(id, envs), begin_stops(envs), strict=True)
            for thread in stops.values():
                thread.join(_STOP_SECONDS)
            is_over.wait(_LOOK_SECONDS)

    thread = Thread(target=watch, name="stops hardware", daemon=True)
    thread.start()

    def end() -> None:
        is_over.set()
        thread.join()

    return end


@contextlib.contextmanager
def stopped_by_signals() -> Generator[None]:
    """Have signals that the program handles stop `HELD`, too, while the block is executed.

    An event loop only notes Ctrl-C, so nothing else would end a motion that blocks it.
    """
    before: dict[int, Any] = {}

    def handle(number: int, frame: Any) -> None:
        for env in list(HELD):  # By itself, as only one is at work, and is stopped again and again.
            ends.callback(watched(lambda env=env: [env]))
        before[number](number, frame)

    with contextlib.ExitStack() as ends:
        try:
            if current_thread() is main_thread():
                for number in _SIGNALS:
                    if callable(handler := signal.getsignal(number)):
                        before[number] = handler
                        signal.signal(number, handle)
            yield
        finally:
            for number, handler in before.items():
                if signal.getsignal(number) is handle:  # The env may have set another.
                    signal.signal(number, handler)


@contextlib.contextmanager
def signals_held_back() -> Generator[None]:
    """Handle signals after the block, for what must not be left half done."""
    if current_thread() is not main_thread():
        yield  # Handlers run in the main thread alone.
        return
    caught: list[int] = []
    before: dict[int, Any] = {}
    try:
        for number in _SIGNALS:
            if signal.getsignal(number) is not None:  # None: not Python's.
                before[number] = signal.signal(number, lambda number, _: caught.append(number))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in caught:
            signal.raise_signal(number)


def limit_actions(env: BaseEnv, seconds: Any) -> None:
    """Stop an env when no action comes for so long, and refuse steps then until its next reset.

    The time begins with the end of a reset, and again with each step.

    Raises:
        ConfigError: `seconds` is no positive number, or the env is awaitable.
    """
    where = f"{env.env_id}: env_kwargs.{ACTION_TIMEOUT}"
    if type(seconds) not in (int, float) or not 0 < seconds < math.inf:
        raise ConfigError(f"{where}: should be a number of seconds above 0, not {seconds!r}")
    if is_awaitable(env):
        raise ConfigError(f"{where}: an awaitable env can't have it")
    step_name = "step_async" if is_async_first(env) else "step"
    reset, step, close = env.reset, getattr(env, step_name), env.close
    due, expired = math.inf, False
    deciding = Lock()  # Whether a step came in time: one that moves after the stop isn't stopped.

    def timed_reset(**arguments: Any) -> Any:
        nonlocal due, expired
        with deciding:
            due, expired = math.inf, False
        result = reset(**arguments)
        due = time.monotonic() + seconds
        return result

    def timed_step(policy_resp: PolicyResponse) -> Any:
        nonlocal due
        with deciding:
            if expired:
                raise RuntimeError(
                    f"{env.env_id}: stopped, as no action came for {seconds:g} s (action_timeout); "
                    "reset() starts it again"
                )
            due = time.monotonic() + seconds
        return step(policy_resp)

    def late() -> list[BaseEnv]:
        nonlocal due, expired
        with deciding:
            if time.monotonic() < due:
                return []
            due, expired = math.inf, True
        return [env]

    def timed_close() -> Any:
        nonlocal due
        due = math.inf
        end()
        return close()

    changed: Any = env
    changed.reset, changed.close = timed_reset, timed_close
    setattr(env, step_name, timed_step)
    if isinstance(env, FastPath):
        changed.bare_step = changed.bare_reset = lambda: None
    end = watched(late)
